"""Pictures of scenes, drawn in software."""

from scene_envs.render.cameras import picture_camera
from scene_envs.render.galleries import gallery
from scene_envs.render.pictures import render

__all__ = ["gallery", "picture_camera", "render"]
