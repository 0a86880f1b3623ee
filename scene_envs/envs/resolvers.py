"""Resolvers of reward and prior names through entry points."""

from __future__ import annotations

from functools import cache
from typing import Any

from scene_envs.errors import MissingDependencyError
from scene_envs.plugins import plugin_entry_points
from scene_envs.protocols import PriorLike, SceneScorer

ENTRY_POINT_GROUP = "scene_envs.resolvers"
"""Entry points of this group. ``reward = "module:function"`` names a function with the argument of
:func:`resolve_reward` that returns a :class:`~scene_envs.protocols.SceneScorer`. ``prior = "module:function"`` names a
function of a name or path that returns a :class:`~scene_envs.protocols.PriorLike`."""


def resolve_reward(reward: Any) -> SceneScorer:
    """Scorer of ``reward``: a registered name, a mapping with settings, a function or a reward object.

    Raises:
        UnknownNameError: no reward has that name; the nearest known one is offered.
        MissingDependencyError: no installed package resolves rewards.
    """
    return _resolver("reward")(reward)


def resolve_prior(prior: Any) -> PriorLike:
    """A prior from a name or a path; any other value is returned unchanged.

    Raises:
        UnknownNameError: no shipped prior has that name; the nearest known one is offered.
        MissingDependencyError: no installed package resolves priors.
    """
    return _resolver("prior")(prior) if isinstance(prior, str) else prior


@cache
def _resolver(kind: str) -> Any:
    points = plugin_entry_points(ENTRY_POINT_GROUP)
    if kind not in points:
        raise MissingDependencyError(
            f"no installed package resolves a {kind}: none has the entry point {kind!r} in the group "
            f"{ENTRY_POINT_GROUP!r}; reinstall SceneEnvs (in a checkout: `pip install -e .`)"
        )
    return points[kind].load()
