"""Planners by name, and the settings that make them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar

from scene_envs.errors import InvalidInputError
from scene_envs.registry import Registry

ENTRY_POINT_GROUP = "scene_envs.planners"
"""Entry points of installed packages: modules that call :func:`register_planner` when they are imported."""


PER_STATE = ("children", "parallel")
"""Keys of planners in which null means ``branching``, the children of a state that the user asks for."""


@dataclass(frozen=True)
class PlannerSettings:
    """A planner by name, and its keys.

    Attributes:
        name: name of a registered planner.
    """

    name: str = ""
    widens: ClassVar[bool] = False
    """Whether the planner itself chooses the number of children of a state. In a search run, a state then has as many
    actions as the budget, instead of ``branching``."""
    steers: ClassVar[bool] = False
    """Whether the planner itself steers the denoising."""

    def make(self, branching: int) -> Any:
        """The planner: an object with ``plan(problem, budget, progress)``, as :class:`agents.planning.GreedyPlanner`.

        Settings with a method ``plan`` are the planner themselves, with ``branching`` in place of null in the keys of
        :data:`PER_STATE`.

        Args:
            branching: children of a state, as the user asks for them.
        """
        unset: dict[str, Any] = {name: branching for name in PER_STATE if getattr(self, name, branching) is None}
        return replace(self, **unset) if unset else self


_SHIPPED = ("beam", "best_of", "evolution", "feynman_kac", "gradient", "greedy", "mcts")
_PLANNERS: Registry[type[PlannerSettings]] = Registry(
    "planner",
    ENTRY_POINT_GROUP,
    modules={name: f"agents.planning.{name}" for name in _SHIPPED},
)
Settings = TypeVar("Settings", bound=type[PlannerSettings])


def register_planner(name: str) -> Callable[[Settings], Settings]:
    """Make a planner available as ``planner=name``; decorates the dataclass of the planner's keys.

    The method ``make`` of the dataclass makes the planner.

    Raises:
        InvalidInputError: the name is not one word.
    """
    _PLANNERS.check_name(name, "beam")
    return _PLANNERS.adding(name)


def list_planners() -> list[str]:
    """Names of all planners, those of installed packages included, sorted."""
    return _PLANNERS.names()


def planner_settings(name: str) -> type[PlannerSettings]:
    """The dataclass of a planner's keys.

    Raises:
        UnknownNameError: no planner has that name; the nearest known one is offered.
    """
    return _PLANNERS[name]


def check_at_least(planner: PlannerSettings, least: float, *names: str) -> None:
    """Raise InvalidInputError where a key is below ``least`` or not finite; keys that are None are left to ``make``."""
    for name in names:
        value = getattr(planner, name)
        if value is not None and not (least <= value < float("inf")):
            raise InvalidInputError(f"planner {planner.name}: {name} must be a number >= {least:g}, got {value}")
