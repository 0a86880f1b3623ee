"""What all tests of physics share."""

from __future__ import annotations

import pytest

from scene_envs.physics import motion


@pytest.fixture(autouse=True)
def nothing_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every simulation is made: one that is compared with an earlier one would be the earlier one itself."""
    monkeypatch.setattr(motion, "_KNOWN", 0)
