"""Pictures and sensor images of scenes, drawn in software, and a viewer for browsers.

Names load on first use, so that cameras and the rasteriser work without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from scene_envs.render.pictures import gallery, observe, render
    from scene_envs.render.raster import Pinhole
    from scene_envs.render.stage import picture_camera
    from scene_envs.render.viewer import viewer_page, write_viewer

__all__ = ["Pinhole", "gallery", "observe", "picture_camera", "render", "viewer_page", "write_viewer"]

__getattr__ = lazy_names(__name__, __file__)
