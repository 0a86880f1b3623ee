"""Search session: several plans in lock-step over one environment, with limits, interrupts and a journal."""

from __future__ import annotations

import itertools
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from agents.planning.journal import Journal
from agents.planning.ledger import PlanResult, Progress, Searchable, SearchStoppedError, state_value
from agents.utils.interrupts import Terminated, terminable
from scene_envs.errors import InvalidInputError

Pairs = Sequence[tuple[Any, int]]
Request = tuple[Pairs, Any]
"""Request for expansions: pairs and their steering, None for no steering."""
Ask = Callable[[Request], Sequence[Any]]


class Lane:
    """One plan's view of a session: the environment with the plan's own root, and a record of the plan's expansions.

    Args:
        problem: the environment.
        root: state that the plan starts from.
        budget: largest number of expansions.
        ask: function that expands pairs for this lane.
        root_counts: whether the root may be the best state.

    Attributes:
        values: objective of every expansion; NaN where it failed.
        best: the highest value and its state.
        first: children of the root, in the order they were made.
    """

    def __init__(self, problem: Searchable, root: Any, budget: int, ask: Ask, root_counts: bool = False) -> None:
        self.problem, self.root, self.budget, self.ask, self.root_counts = problem, root, budget, ask, root_counts
        self.values: list[float] = []
        self.start = state_value(problem, root) if root_counts else math.nan
        self.best: tuple[float, Any] = (self.start if math.isfinite(self.start) else -math.inf, root)
        self.first: list[Any] = []

    def clone_state(self) -> Any:
        """The root of the plan."""
        return self.root

    def legal_actions(self, state: Any) -> Sequence[int]:
        """Actions that can be expanded from ``state``."""
        return self.problem.legal_actions(state)

    def evaluate(self, state: Any) -> float:
        """The objective of ``state``, in [0, 1]."""
        return self.problem.evaluate(state)

    def expand_batch(self, pairs: Pairs, steering: Any = None) -> list[Any]:
        """The child of every pair; raises SearchStoppedError when the budget is spent or the session ends."""
        if len(self.values) + len(pairs) > self.budget:
            raise SearchStoppedError(f"the budget of {self.budget} expansions is spent")
        states = list(self.ask((pairs, steering)))
        for (parent, _), state in zip(pairs, states, strict=True):
            if parent is self.root:
                self.first.append(state)
            value = state_value(self.problem, state)
            self.values.append(value)
            if value > self.best[0]:
                self.best = (value, state)
        return states

    def __getattr__(self, name: str) -> Any:
        return getattr(self.problem, name)

    def result(self) -> PlanResult:
        """The result for a planner that did not return one: the best state seen."""
        value, state = self.best
        path = getattr(state, "path", ()) if self.values else ()
        return PlanResult(state, value if value > -math.inf else math.nan, path, self.values, start=self.start)


class Session:
    """Plans over one environment that run until they end, the time limit is reached, or the user interrupts.

    The rounds of all plans are joined into one batch of the environment. With a journal, every round is written to disk
    before a plan sees it. A session that was killed reads these rounds instead of expanding them again, so it continues
    where it stopped.

    Args:
        problem: the environment.
        max_seconds: seconds after which the plans end, at the earliest after their first round; None for no limit.
        journal: record of the rounds; None keeps none.

    Attributes:
        stopped: ``"time"``, ``"interrupt"`` or ``"terminated"`` (SIGTERM); empty when the plans came to their end.
        lanes: one :class:`Lane` per plan, which records its expansions.
    """

    def __init__(
        self, problem: Searchable, *, max_seconds: float | None = None, journal: Journal | None = None
    ) -> None:
        if max_seconds is not None and not max_seconds > 0:
            raise InvalidInputError(f"max_seconds={max_seconds} must be more than 0, or null for no limit")
        self.problem, self.max_seconds, self.journal = problem, max_seconds, journal
        self.stopped = ""
        self._begun = time.perf_counter()
        self._rounds = 0
        self.lanes: list[Lane] = []

    def run(
        self,
        planner: Any,
        roots: Sequence[Any],
        budget: int,
        progress: Progress | None = None,
        *,
        root_counts: bool = False,
    ) -> list[PlanResult]:
        """One plan of ``budget`` expansions per root.

        Args:
            planner: object with a method ``plan(problem, budget, progress)``.
            roots: states that the plans start from.
            budget: expansions of each plan.
            progress: called with the expansions of all plans together, and with the lowest of the plans' best values.
            root_counts: whether a root may be the best state of its plan.
        """
        lanes = self.lanes = [Lane(self.problem, root, budget, self._expand, root_counts) for root in roots]
        report = None if progress is None else lambda *_: progress(*_overall(lanes))
        with terminable():
            if len(lanes) > 1:
                return self._run_together(planner, lanes, report)
            try:
                return [_plan(planner, lanes[0], report)]
            except KeyboardInterrupt as interrupt:  # between two rounds
                self.stopped = _reason(interrupt)
                return [lanes[0].result()]

    def _run_together(self, planner: Any, lanes: list[Lane], report: Progress | None) -> list[PlanResult]:
        """Run the plans in threads, one at a time and in order: each runs until it asks for expansions or ends."""
        messages: queue.Queue[Request | PlanResult | BaseException] = queue.Queue()
        answers: list[queue.Queue[Sequence[Any] | None]] = [queue.Queue() for _ in lanes]

        def asks(index: int) -> Ask:
            def ask(asked: Request) -> Sequence[Any]:
                messages.put(asked)
                answer = answers[index].get()
                if answer is None:
                    raise SearchStoppedError("the search was stopped")
                return answer

            return ask

        def work(index: int) -> None:
            try:
                messages.put(_plan(planner, lanes[index], None))
            except BaseException as error:
                messages.put(error)

        results: dict[int, PlanResult] = {}
        failure: BaseException | None = None
        waiting: dict[int, Request] = {}

        def receive(index: int) -> None:
            nonlocal failure
            message: Any = None
            while message is None:
                try:
                    message = messages.get()
                except KeyboardInterrupt as interrupt:
                    self.stopped = _reason(interrupt)
            if isinstance(message, PlanResult):
                results[index] = message
            elif isinstance(message, BaseException):
                failure = failure or message
            else:
                waiting[index] = message

        for index, lane in enumerate(lanes):
            lane.ask = asks(index)
            threading.Thread(target=work, args=(index,), daemon=True).start()
            receive(index)
        while waiting:
            asked, waiting = waiting, {}
            states: list[Any] = []
            try:
                for steering, part in itertools.groupby(asked.values(), key=lambda one: one[1]):
                    if failure is None:
                        states += self._expand(([pair for pairs, _ in part for pair in pairs], steering))
            except SearchStoppedError:
                pass
            except Exception as error:  # ends all plans, and is raised when they are over
                failure = error
            for index, (pairs, _) in asked.items():
                enough = failure is None and len(states) >= len(pairs)
                answers[index].put(states[: len(pairs)] if enough else None)
                states = states[len(pairs) :] if enough else []
                receive(index)
            if report is not None:
                report(0, 0.0)
        if failure is not None:
            raise failure
        return [results[index] for index in sorted(results)]

    def _expand(self, asked: Request) -> Sequence[Any]:
        """The children of one joint round: from the journal, or made now and written there."""
        pairs, steering = asked
        if self.stopped:
            raise SearchStoppedError(f"the search was stopped: {self.stopped}")
        known = [] if self.journal is None else self.journal.take(pairs)
        if len(known) == len(pairs):
            self._rounds += 1
            return known
        late = self.max_seconds is not None and time.perf_counter() - self._begun > self.max_seconds
        if late and self._rounds:
            self.stopped = "time"
            raise SearchStoppedError(f"max_seconds={self.max_seconds} are over")
        try:
            how = () if steering is None else (steering,)
            states = self.problem.expand_batch(pairs[len(known) :], *how)
            if self.journal is not None:
                self.journal.add(states)
        except KeyboardInterrupt as interrupt:
            self.stopped = _reason(interrupt)
            raise SearchStoppedError("the search was interrupted") from None
        self._rounds += 1
        return [*known, *states]


def _reason(interrupt: KeyboardInterrupt) -> str:
    return "terminated" if isinstance(interrupt, Terminated) else "interrupt"


def _plan(planner: Any, lane: Lane, report: Progress | None) -> PlanResult:
    try:
        return planner.plan(lane, lane.budget, report)
    except SearchStoppedError:  # the planner did not catch it
        return lane.result()


def _overall(lanes: Sequence[Lane]) -> tuple[int, float]:
    return sum(len(lane.values) for lane in lanes), max(0.0, min(lane.best[0] for lane in lanes))
