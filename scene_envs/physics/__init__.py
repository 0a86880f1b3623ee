"""Physics of scenes: overlap, feasibility, settling, projection, and the worker processes that compute them.

Names load on first use, so that worker processes start without torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from scene_envs.physics.api import (
        EquilibriumResult,
        FeasibilityResult,
        ObjectPair,
        PenetrationResult,
        ProjectionResult,
        ReadyResult,
        SettleResult,
        equilibrium,
        feasibility,
        furniture_overlap,
        penetration,
        project,
        settle,
    )
    from scene_envs.physics.pool import PhysicsPool, make_pool
    from scene_envs.physics.readiness import make_ready

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
    "furniture_overlap",
    "make_pool",
    "make_ready",
    "penetration",
    "project",
    "settle",
]

__getattr__ = lazy_names(__name__, __file__)
