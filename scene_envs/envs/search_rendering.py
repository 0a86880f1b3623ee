"""Rendering of a search: a picture, or a page in the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from scene_envs.envs.search import SearchState
from scene_envs.envs.spaces import check_render_mode, picture
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.render import LiveViewer


class SearchRendering:
    """Rendering of the search environments.

    Args:
        mode: ``"rgb_array"`` for pictures with masked objects in red; ``"human"`` for a page in the browser that shows
            each state as another scene; None for no rendering.
    """

    MODES = ("human", "rgb_array")

    def __init__(self, mode: str | None) -> None:
        self.mode = check_render_mode(mode, self.MODES)
        self._viewer: LiveViewer | None = None

    def picture(self, scene: SceneBatch, state: SearchState) -> np.ndarray | None:
        """(H, W, 3) uint8 picture with mode ``"rgb_array"``; None otherwise."""
        if self.mode != "rgb_array":
            return None
        return picture(scene, highlight=state.mask.unsqueeze(0))[0]

    def show(self, scene: SceneBatch, state: SearchState) -> None:
        """Add a state to the page with mode ``"human"``."""
        if self.mode != "human":
            return
        if self._viewer is None:
            from scene_envs.render import LiveViewer

            self._viewer = LiveViewer(f"search of {scene.scene_type.name.replace('_', ' ')}")
        masked = int((state.mask & ~scene.is_empty[0]).sum())
        empty = int(state.mask.sum()) - masked
        value = f"depth {state.depth}: objective {state.objective:.4g}"
        self._viewer.show(scene, f"{value}, {masked} objects and {empty} empty slots masked")

    def close(self) -> None:
        """Close the viewer; its page remains."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None
