"""Live viewer: a page in the browser that shows scenes as they are added."""

from __future__ import annotations

import tempfile
import webbrowser
from pathlib import Path

from gymnasium import logger

from scene_envs.render.viewer import write_viewer
from scene_envs.scene import SceneBatch


class LiveViewer:
    """All scenes shown so far, in one page that the browser reads again every two seconds.

    The page lies in a temporary folder, and stays there when the viewer is closed.

    Args:
        title: Heading of the page.

    Attributes:
        path: Path of the page.
    """

    REFRESH = 2.0
    """Seconds between two readings of the page."""

    def __init__(self, title: str) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="scene-envs-")) / "viewer.html"
        self._title = title
        self._scenes: list[SceneBatch] = []
        self._captions: list[str] = []

    def show(self, scene: SceneBatch, caption: str) -> None:
        """Add a scene (a batch of one); the first one opens the browser."""
        self._scenes.append(scene)
        self._captions.append(caption)
        self._write(self.REFRESH)
        if len(self._scenes) == 1 and not webbrowser.open(self.path.resolve().as_uri()):
            logger.warn(f"no browser was found; open {self.path} in one")

    def close(self) -> None:
        """Write the page a last time, without refresh; it stays in its folder."""
        if self._scenes:
            self._write(None)
            self._scenes, self._captions = [], []

    def _write(self, refresh: float | None) -> None:
        batch = SceneBatch.concatenate(self._scenes)
        write_viewer(batch, self.path, captions=self._captions, title=self._title, refresh=refresh)
