"""Pictures of scenes, drawn in software, and a viewer for browsers."""

from scene_envs.render.pictures import gallery, render
from scene_envs.render.stage import picture_camera
from scene_envs.render.viewer import LiveViewer, viewer_page, write_viewer

__all__ = ["LiveViewer", "gallery", "picture_camera", "render", "viewer_page", "write_viewer"]
