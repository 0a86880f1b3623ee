"""Physics of scenes: overlap, feasibility, settling, projection, and the worker processes that do it.

Names load on first use, so that worker processes start without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scene_envs.physics.api import equilibrium, feasibility, make_ready, penetration, project, settle
    from scene_envs.physics.pool import PhysicsPool
    from scene_envs.physics.results import (
        EquilibriumResult,
        FeasibilityResult,
        ObjectPair,
        PenetrationResult,
        ProjectionResult,
        ReadyResult,
        SettleResult,
    )

_API = ("equilibrium", "feasibility", "make_ready", "penetration", "project", "settle")

__all__ = [
    "EquilibriumResult",
    "FeasibilityResult",
    "ObjectPair",
    "PenetrationResult",
    "PhysicsPool",
    "ProjectionResult",
    "ReadyResult",
    "SettleResult",
    "equilibrium",
    "feasibility",
    "make_ready",
    "penetration",
    "project",
    "settle",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'scene_envs.physics' has no attribute {name!r}")
    module = "api" if name in _API else "pool" if name == "PhysicsPool" else "results"
    return getattr(import_module(f"scene_envs.physics.{module}"), name)
