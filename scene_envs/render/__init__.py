"""Pictures of scenes, drawn in software, and a viewer for browsers."""

from scene_envs.render.cameras import picture_camera
from scene_envs.render.galleries import gallery
from scene_envs.render.live import LiveViewer
from scene_envs.render.pictures import render
from scene_envs.render.viewer import viewer_page, write_viewer

__all__ = ["LiveViewer", "gallery", "picture_camera", "render", "viewer_page", "write_viewer"]
