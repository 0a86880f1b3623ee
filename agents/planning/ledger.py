"""The budget of a search and its best state so far, and the protocol of the trees that planners search."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from scene_envs.errors import Checked, InvalidInputError, SceneEnvsError
from scene_envs.registry import Registry

Progress = Callable[[int, float], None]
"""Called after every round with the expansions so far and the best value so far."""


class SearchStoppedError(SceneEnvsError):
    """Raised when a search must end, because of its time limit or an interrupt.

    Planners built on a :class:`SearchBudget` return their best state. If another planner does not catch this error, the
    run that started the planner keeps the best state that it saw.

    Attributes:
        states: children of the first pairs of the round, made before the search had to end.
    """

    states: Sequence[Any] = ()


class Searchable(Protocol):
    """Protocol of the trees that a planner searches, such as ``scene_envs.envs.SearchEnv``.

    States are immutable. A state whose attribute ``valid`` is False could not be scored: its expansion is counted, and
    the state is left out of the plan. Two states with equal attributes ``fingerprint`` hold the same scene. If the
    attribute ``root_counts`` of the tree is True, the root is a scene that may itself be the best.
    """

    def clone_state(self) -> Any:
        """The current state, the root of the plan."""

    def legal_actions(self, state: Any) -> Sequence[int]:
        """Actions that can be expanded from ``state``; none at a leaf."""

    def expand_batch(self, pairs: Sequence[tuple[Any, int]]) -> Sequence[Any]:
        """The child of every (state, action) pair."""

    def evaluate(self, state: Any) -> float:
        """The objective of ``state``, in [0, 1]."""


@dataclass
class PlanResult:
    """Result of a planner.

    Attributes:
        best_state: the state with the highest objective.
        best_value: its objective.
        best_path: the actions that lead to it from the root.
        values: objective of every expansion in the order they were made; NaN where it failed.
        start: objective of the root where it may be the best scene; NaN otherwise.
    """

    best_state: Any
    best_value: float
    best_path: tuple[int, ...]
    values: list[float]
    start: float = math.nan

    @property
    def curve(self) -> list[float]:
        """Best objective after each expansion; failed expansions do not change it.

        A better state that cost no expansion is counted at the last expansion.
        """
        best, curve = self.start if math.isfinite(self.start) else -math.inf, []
        for value in self.values:
            best = max(best, value) if math.isfinite(value) else best
            curve.append(best)
        if curve and self.best_value > curve[-1]:
            curve[-1] = self.best_value
        return curve


@dataclass(frozen=True, eq=False)
class Candidate:
    """A state that was expanded."""

    state: Any  # the problem's own immutable state
    value: float  # objective of the state, in [0, 1]; NaN if it could not be scored
    path: tuple[int, ...]  # actions from the root to the state

    @property
    def valid(self) -> bool:
        """Whether the state has a value."""
        return math.isfinite(self.value)

    @property
    def fingerprint(self) -> Any:
        """A key that is equal for equal scenes; the path if the state has no fingerprint."""
        return getattr(self.state, "fingerprint", self.path)


Member = tuple[Candidate, Sequence[int]]
"""A candidate and its remaining actions."""


def best_different(pool: Sequence[Member], count: int) -> list[Member]:
    """The ``count`` best different scenes of ``pool`` that have actions left; the first among equals."""
    kept: list[Member] = []
    seen = set()
    for state, actions in sorted(pool, key=lambda entry: -entry[0].value if entry[0].valid else 0.0):
        if actions and state.fingerprint not in seen and len(kept) < count:
            seen.add(state.fingerprint)
            kept.append((state, actions))
    return kept


class SearchBudget:
    """Budget of expansions of a planner, and a record of their results; an InvalidInputError if it is below 1.

    :attr:`left` is 0 when the budget is spent, when a state of value 1 (the largest value) was found, or when the
    problem stops the search. ``progress`` is called after every round.
    """

    def __init__(self, problem: Searchable, budget: int, progress: Progress | None = None) -> None:
        if budget < 1:
            raise InvalidInputError(f"a plan needs a budget of at least 1 expansion, got {budget}")
        self.problem, self.budget, self.progress = problem, budget, progress
        root = problem.clone_state()
        value = state_value(problem, root) if getattr(problem, "root_counts", False) else math.nan
        self.root = Candidate(root, value, ())
        self.values: list[float] = []
        self.best = self.root
        self._stopped = False

    @property
    def left(self) -> int:
        """Number of expansions that may still be made."""
        return 0 if self._stopped or self.best.value >= 1.0 else self.budget - len(self.values)

    def generator(self, seed: int) -> np.random.Generator:
        """Random generator for a planner's own choices, seeded by ``seed`` and by the seed of the root."""
        return np.random.default_rng([seed, getattr(self.root.state, "seed", 0)])

    def actions(self, candidate: Candidate) -> Sequence[int]:
        """Legal actions of ``candidate``."""
        return self.problem.legal_actions(candidate.state)

    def expand(self, pairs: Sequence[tuple[Candidate, int]]) -> list[Candidate]:
        """The children of the first :attr:`left` (candidate, action) pairs; fewer if the search is stopped."""
        pairs = pairs[: self.left]
        if not pairs:
            return []
        try:
            states = self.problem.expand_batch([(parent.state, action) for parent, action in pairs])
        except SearchStoppedError as stop:
            self._stopped, states = True, stop.states
        children = [
            Candidate(state, state_value(self.problem, state), (*parent.path, action))
            for (parent, action), state in zip(pairs, states, strict=not self._stopped)
        ]
        for child in children:
            self.values.append(child.value)
            self.keep(child)
        if self.progress is not None and children:
            self.progress(len(self.values), self.best.value if self.best.valid else 0.0)
        return children

    def keep(self, candidate: Candidate) -> None:
        """Make ``candidate`` the best so far if it ranks higher; planners call it for states that cost no expansion."""
        if candidate.valid and (not self.best.valid or _rank(candidate) < _rank(self.best)):
            self.best = candidate

    def result(self) -> PlanResult:
        """The plan: the best state; among equals, the one with the shortest path, then with the first path."""
        return PlanResult(self.best.state, self.best.value, self.best.path, self.values, self.root.value)


class SteeredProblem:
    """A search problem whose expansions get ``steering``, which the planner called ``planner`` may change; an
    InvalidInputError if the expansions of ``problem`` cannot be steered.
    """

    def __init__(self, problem: Any, planner: str, steering: Any = None) -> None:
        if "steering" not in inspect.signature(problem.expand_batch).parameters:
            takes = f"expand_batch of {type(problem).__name__} takes no steering="
            raise InvalidInputError(f"planner {planner} steers the denoising, and {takes}; choose another planner")
        self.problem, self.steering = problem, steering

    def expand_batch(self, pairs: Sequence[tuple[Any, int]]) -> Sequence[Any]:
        """The child of every pair."""
        return self.problem.expand_batch(pairs, steering=self.steering)  # type: ignore[no-any-return]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)


def state_value(problem: Searchable, state: Any) -> float:
    """The objective of ``state``, NaN when it could not be scored."""
    return float(problem.evaluate(state)) if getattr(state, "valid", True) else math.nan


def _rank(candidate: Candidate) -> tuple[float, int, tuple[int, ...]]:
    return -candidate.value, len(candidate.path), candidate.path


ENTRY_POINT_GROUP = "scene_envs.planners"
"""Entry points of installed packages: modules that call :func:`register_planner` when they are imported."""
PER_STATE = ("children", "parallel")
"""Keys of planners in which null means ``branching``, the children of a state that the user asks for."""


@dataclass(frozen=True)
class PlannerSettings(Checked):
    """A planner by name, and its keys.

    Attributes:
        name: name of a registered planner.
    """

    name: str = ""
    widens: ClassVar[bool] = False
    """Whether the planner itself chooses the number of children of a state; in a search run, a state then has as many
    actions as the budget."""
    steers: ClassVar[bool] = False
    """Whether the planner itself steers the denoising."""

    @property
    def place(self) -> str:  # type: ignore[override]
        """What stands in front of the name of a key in messages."""
        return f"planner {self.name}: "

    def make(self, branching: int) -> Any:
        """The planner: an object with ``plan(problem, budget, progress)``, as :class:`agents.planning.GreedyPlanner`.
        Settings with a method ``plan`` are themselves the planner, with ``branching``, the number of children of a
        state, in place of null in the keys of :data:`PER_STATE`.
        """
        unset: dict[str, Any] = {name: branching for name in PER_STATE if getattr(self, name, branching) is None}
        return replace(self, **unset) if unset else self


_SHIPPED = {name: name for name in ("evolution", "gradient", "mcts")}
_SHIPPED |= dict.fromkeys(("beam", "best_of", "greedy"), "simple")
_PLANNERS: Registry[type[PlannerSettings]] = Registry(
    "planner", ENTRY_POINT_GROUP, modules={name: f"agents.planning.{file}" for name, file in _SHIPPED.items()}
)
Settings = TypeVar("Settings", bound=type[PlannerSettings])


def register_planner(name: str) -> Callable[[Settings], Settings]:
    """Make a planner available as ``planner=name``. It decorates the dataclass of the keys, whose method ``make`` makes
    the planner. An InvalidInputError if the name is not one word.
    """
    _PLANNERS.check_name(name, "beam")
    return _PLANNERS.adding(name)


def list_planners() -> list[str]:
    """Names of all planners, those of installed packages included, sorted."""
    return _PLANNERS.names()


def planner_settings(name: str) -> type[PlannerSettings]:
    """The dataclass of a planner's keys; an UnknownNameError offers the nearest known name."""
    return _PLANNERS[name]
