"""Search session: several plans in lock-step over one environment, with limits, interrupts and a journal."""

from __future__ import annotations

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
Ask = Callable[[Pairs], Sequence[Any]]


class Lane:
    """One plan's view of a session: the environment with a root of its own, whose expansions are recorded.

    Args:
        problem: the environment.
        root: state that the plan starts from.
        budget: expansions.
        ask: expands pairs for this lane.

    Attributes:
        values: objective of every expansion; NaN where it failed.
        best: the highest value and its state.
        first: children of the root, in the order they were made.
    """

    def __init__(self, problem: Searchable, root: Any, budget: int, ask: Ask) -> None:
        self.problem, self.root, self.budget, self.ask = problem, root, budget, ask
        self.values: list[float] = []
        self.best: tuple[float, Any] = (float("-inf"), root)
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

    def expand_batch(self, pairs: Pairs) -> list[Any]:
        """The child of every pair; raises SearchStoppedError when the budget is spent or the session ends."""
        if len(self.values) + len(pairs) > self.budget:
            raise SearchStoppedError(f"the budget of {self.budget} expansions is spent")
        states = list(self.ask(pairs))
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
        """What is kept of a planner that did not return."""
        value, state = self.best
        path = getattr(state, "path", ()) if self.values else ()
        return PlanResult(state, value if value > float("-inf") else float("nan"), path, self.values)


class Session:
    """Runs plans over one environment until they are done, time is over, or the user interrupts.

    The rounds of all plans are joined into one batch of the environment. With a journal, every round is written to the
    disk before a plan sees it, and a session that was killed takes what is written instead of expanding anew, so that
    it goes on where it was.

    Args:
        problem: the environment.
        max_seconds: time after which nothing more is expanded, but for the first round; None for no limit.
        journal: of the rounds; None keeps none.

    Attributes:
        stopped: ``"time"``, ``"interrupt"`` or ``"terminated"`` (SIGTERM); empty when the plans came to their end.
        lanes: what was seen of every plan.
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
        self, planner: Any, roots: Sequence[Any], budget: int, progress: Progress | None = None
    ) -> list[PlanResult]:
        """One plan of ``budget`` expansions per root.

        Args:
            planner: has ``plan(problem, budget, progress)``.
            roots: states that the plans start from.
            budget: expansions of each plan.
            progress: told of the expansions of all plans together, and of the best value of the worst of them.
        """
        lanes = self.lanes = [Lane(self.problem, root, budget, self._expand) for root in roots]
        told = None if progress is None else lambda *_: progress(*_overall(lanes))
        with terminable():
            if len(lanes) == 1:
                return [_plan(planner, lanes[0], told)]
            return self._run_together(planner, lanes, told)

    def _run_together(self, planner: Any, lanes: list[Lane], told: Progress | None) -> list[PlanResult]:
        """Plans in threads that wait for each other: one asks or ends before any other goes on, in their order."""
        asked: queue.Queue[tuple[int, Pairs | PlanResult | BaseException]] = queue.Queue()
        answers: list[queue.Queue[Sequence[Any] | None]] = [queue.Queue() for _ in lanes]

        def asks(index: int) -> Ask:
            def ask(pairs: Pairs) -> Sequence[Any]:
                asked.put((index, pairs))
                answer = answers[index].get()
                if answer is None:
                    raise SearchStoppedError("the search was stopped")
                return answer

            return ask

        def work(index: int) -> None:
            try:
                asked.put((index, _plan(planner, lanes[index], None)))
            except BaseException as error:
                asked.put((index, error))

        for index, lane in enumerate(lanes):
            lane.ask = asks(index)
            threading.Thread(target=work, args=(index,), daemon=True).start()
        results: list[PlanResult | None] = [None] * len(lanes)
        running, failure = set(range(len(lanes))), None
        waiting: dict[int, Pairs] = {}
        while running:
            try:
                while len(waiting) < len(running):
                    index, what = asked.get()
                    if isinstance(what, PlanResult | BaseException):
                        running.discard(index)
                    if isinstance(what, PlanResult):
                        results[index] = what
                    elif isinstance(what, BaseException):
                        failure = failure or what
                    else:
                        waiting[index] = what
            except KeyboardInterrupt as interrupt:
                self.stopped = _reason(interrupt)
                continue
            states: Sequence[Any] | None = None
            order = sorted(waiting)
            try:
                if order and failure is None:
                    states = self._expand([pair for index in order for pair in waiting[index]])
            except SearchStoppedError:
                pass
            except Exception as error:  # ends all plans, and is raised when they are over
                failure = error
            for index in order:
                pairs = waiting.pop(index)
                answers[index].put(None if states is None else states[: len(pairs)])
                states = None if states is None else states[len(pairs) :]
            if told is not None and states is not None:
                told(0, 0.0)
        if failure is not None:
            raise failure
        return [result for result in results if result is not None]

    def _expand(self, pairs: Pairs) -> Sequence[Any]:
        """The children of one joint round: from the journal, or made now and written there."""
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
            states = self.problem.expand_batch(pairs[len(known) :])
            if self.journal is not None:
                self.journal.add(states)
        except KeyboardInterrupt as interrupt:
            self.stopped = _reason(interrupt)
            raise SearchStoppedError("the search was interrupted") from None
        self._rounds += 1
        return [*known, *states]


def _reason(interrupt: KeyboardInterrupt) -> str:
    return "terminated" if isinstance(interrupt, Terminated) else "interrupt"


def _plan(planner: Any, lane: Lane, told: Progress | None) -> PlanResult:
    try:
        result: PlanResult = planner.plan(lane, lane.budget, told)
    except SearchStoppedError:  # a planner that leaves it to us to keep the best
        return lane.result()
    return result


def _overall(lanes: Sequence[Lane]) -> tuple[int, float]:
    return sum(len(lane.values) for lane in lanes), max(0.0, min(lane.best[0] for lane in lanes))
