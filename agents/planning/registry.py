"""Planners by name, and the settings that make them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, TypeVar

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import load_plugins

ENTRY_POINT_GROUP = "scene_envs.planners"
"""Entry points of installed packages: modules that call :func:`register_planner` when they are imported."""


@dataclass(frozen=True)
class PlannerSettings(ABC):
    """A planner by name, and its keys.

    Attributes:
        name: a registered planner.
    """

    name: str = ""
    widens: ClassVar[bool] = False
    """Whether it chooses itself how many children a state gets. The environment of a search run then has as many
    actions as the budget instead of ``branching``."""

    @abstractmethod
    def make(self, branching: int) -> Any:
        """The planner: an object with ``plan(problem, budget, progress)``, as :class:`agents.planning.UCTPlanner`.

        Args:
            branching: children of a state, as the user asks for them.
        """


_SHIPPED = ("beam", "best_of", "evolution", "feynman_kac", "greedy", "mcts", "uct")
"""Modules of this package that register a planner each."""
_PLANNERS: dict[str, type[PlannerSettings]] = {}
Settings = TypeVar("Settings", bound=type[PlannerSettings])


def register_planner(name: str) -> Callable[[Settings], Settings]:
    """Make a planner available as ``planner=name``; decorates the dataclass of its keys, which makes it.

    Raises:
        InvalidInputError: the name is not one word.
    """
    if not name.isidentifier():
        raise InvalidInputError(f"planner name {name!r}: use letters, digits and underscores, such as 'beam'")

    def register(settings: Settings) -> Settings:
        _PLANNERS[name] = settings
        return settings

    return register


def list_planners() -> list[str]:
    """Names of all planners, those of installed packages included, sorted."""
    _load_shipped()
    load_plugins(ENTRY_POINT_GROUP)
    return sorted(_PLANNERS)


def planner_settings(name: str) -> type[PlannerSettings]:
    """The dataclass of a planner's keys.

    Raises:
        UnknownNameError: no planner has that name; the nearest known one is offered.
    """
    if name not in _PLANNERS:
        _load_shipped()
    if name not in _PLANNERS:
        load_plugins(ENTRY_POINT_GROUP)
    if name not in _PLANNERS:
        raise unknown_name("planner", str(name), list_planners())
    return _PLANNERS[name]


def _load_shipped() -> None:
    """Import the planners of this package, each of which imports this module."""
    for name in _SHIPPED:
        import_module(f"agents.planning.{name}")


def check_at_least(planner: PlannerSettings, least: float, *names: str) -> None:
    """Raise InvalidInputError where a key is below ``least`` or not finite; keys that are None are left to ``make``."""
    for name in names:
        value = getattr(planner, name)
        if value is not None and not (least <= value < float("inf")):
            raise InvalidInputError(f"planner {planner.name}: {name} must be a number >= {least:g}, got {value}")
