"""A machine on which no simulator is installed."""

from __future__ import annotations

from typing import Any

import pytest

from scene_envs import physics
from scene_envs.errors import MissingDependencyError


def no_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every function of the physics that simulates say that it has no simulator."""

    def refuse(*_: Any, **__: Any) -> None:
        raise MissingDependencyError("no simulator here")

    for name in ("feasibility", "make_ready", "equilibrium", "settle"):
        monkeypatch.setattr(physics, name, refuse)
