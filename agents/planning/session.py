"""Search session: several plans in lock-step over one environment, with limits, interrupts and a journal."""

from __future__ import annotations

import io
import itertools
import math
import os
import queue
import struct
import threading
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import torch

from agents.planning.ledger import PlanResult, Progress, Searchable, SearchStoppedError, state_value
from agents.utils.interrupts import Terminated, terminable
from scene_envs.envs import SearchState
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.files import tensors_digest
from scene_envs.scene import SceneBatch

_MAGIC = b"scene-envs search 3\n"
_HEAD = struct.Struct("<II")
"""Length and CRC-32 of a record."""


class Journal:
    """A file of records: the settings of the search, then the states of every round, in order.

    The file at ``path`` is created if it does not exist; the states depend on ``settings``, which are named. A record
    that was being written when the process was killed is dropped. An InvalidInputError if the file was made with other
    settings; a CorruptFileError if it is no journal, or is damaged before its end.
    """

    def __init__(self, path: str | os.PathLike[str], settings: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self._states: list[SearchState] = []
        self._taken = 0
        described = {key: _described(value) for key, value in settings.items()}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        records = self._read() if self.path.exists() else []
        if not records:  # a new file, or a process was killed before the first record was complete
            self.path.write_bytes(_MAGIC)
            self._append(described)
            return
        for name in sorted({*described, *records[0]}):
            before, now = records[0].get(name), described.get(name)
            if before != now:
                raise InvalidInputError(
                    f"{self.path} holds a search with {name}={before}, not {now}; give another output, or that value"
                )
        self._states = [SearchState(**values) for states in records[1:] for values in states]

    def take(self, pairs: Sequence[tuple[SearchState, int]]) -> list[SearchState]:
        """The states that an earlier run made for the first of ``pairs``; as many as the file still has.

        Raises:
            InvalidInputError: the earlier run made states of other pairs.
        """
        known = self._states[self._taken : self._taken + len(pairs)]
        for (parent, action), state in zip(pairs, known, strict=False):
            if (state.seed, state.path) != (parent.seed, (*parent.path, action)):
                raise InvalidInputError(
                    f"{self.path} holds another search: path {state.path} where this one asks for "
                    f"{(*parent.path, action)}; give another output"
                )
        self._taken += len(known)
        return known

    def add(self, states: Sequence[SearchState]) -> None:
        """Write the states of a round."""
        self._append([{field.name: getattr(state, field.name) for field in fields(state)} for state in states])

    def states(self) -> Iterator[SearchState]:
        """All states in the file, in order, with one round in memory at a time."""
        with self.path.open("rb") as file:
            for record in islice(self._records(file), 1, None):
                yield from (SearchState(**values) for values in record)

    def _append(self, content: Any) -> None:
        buffer = io.BytesIO()
        torch.save(content, buffer)
        record = buffer.getvalue()
        with self.path.open("ab") as file:
            file.write(_HEAD.pack(len(record), zlib.crc32(record)) + record)

    def _read(self) -> list[Any]:
        records = []
        with self.path.open("r+b") as file:
            begun = file.read(len(_MAGIC))
            if not _MAGIC.startswith(begun):
                raise CorruptFileError(f"{self.path} is no journal of a search; remove it, or give another output")
            whole = len(begun)
            for record in self._records(file):
                records.append(record)
                whole = file.tell()
            file.truncate(whole)  # a process was killed while writing the rest
        return records

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """The complete records; the file is positioned behind the record that is yielded."""
        file.seek(len(_MAGIC))
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            record = file.read(length)
            if len(record) < length:
                return
            if zlib.crc32(record) != checksum:
                start = file.tell() - length - _HEAD.size
                raise CorruptFileError(f"{self.path} is damaged at byte {start}; remove it, or give another output")
            yield torch.load(io.BytesIO(record), weights_only=True)


def _described(value: Any) -> str:
    """A setting as text, the same in every process: a prior by its weights, an object with ``described_by`` by its
    value, a dataclass by its class and the fields that differ from the defaults, and other objects by their class
    alone.
    """
    if isinstance(value, str | int | float | bool | None):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_described(value[key])}" for key in sorted(value)) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_described, value)) + "]"
    if isinstance(value, SceneBatch):
        return f"{len(value)} scenes {tensors_digest({'scenes': value.tensor})[:16]}"
    if hasattr(value, "weights"):
        return f"weights {tensors_digest({name: tensor.cpu() for name, tensor in value.weights().items()})[:16]}"
    if hasattr(value, "described_by"):
        return _described(value.described_by)
    kind = value if hasattr(value, "__qualname__") else type(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    if isinstance(value, type) or not is_dataclass(value):
        return name
    settings = {
        field.name: getattr(value, field.name)
        for field in fields(value)
        if field.init and field.compare and getattr(value, field.name) != field.default
    }
    return f"{name}{_described(settings)}" if settings else name


Pairs = Sequence[tuple[Any, int]]
Request = tuple[Pairs, Any]
"""Request for expansions: pairs and their steering, None for no steering."""
Ask = Callable[[Request], Sequence[Any]]
"""Makes the children of the pairs of a request; of the first ones alone when the session ends."""
_FIRST_BATCH = 16
"""Scenes that a session with a time limit makes at once before it knows how long one takes."""


class Lane:
    """One plan's view of a session: the environment with the plan's own root, and a record of the plan's expansions:
    their ``values`` (NaN where one failed), the ``best`` value and its state, and the children of the root, ``first``,
    in order.
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

    def expand_batch(self, pairs: Pairs, steering: Any = None) -> list[Any]:
        """The child of every pair; raises SearchStoppedError when the budget is spent or the session ends."""
        if len(self.values) + len(pairs) > self.budget:
            raise SearchStoppedError(f"the budget of {self.budget} expansions is spent")
        states = list(self.ask((pairs, steering)))
        for (parent, _), state in zip(pairs, states, strict=False):
            if parent is self.root:
                self.first.append(state)
            value = state_value(self.problem, state)
            self.values.append(value)
            if value > self.best[0]:
                self.best = (value, state)
        if len(states) < len(pairs):
            stop = SearchStoppedError(f"the session ended after {len(states)} of {len(pairs)} expansions")
            stop.states = states
            raise stop
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
        max_seconds: seconds after which the plans end, at the earliest after the first batch, of 16 scenes at
            most; None for no limit.
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
        self.problem, self.journal = problem, journal
        self.stopped = ""
        self._end = math.inf if max_seconds is None else time.perf_counter() + max_seconds
        self._has_begun = False
        self._pace = 0.0  # scenes per second of the last batch
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
        """One plan of ``budget`` expansions per root, by the method ``plan(problem, budget, progress)`` of ``planner``.
        ``progress`` is called with the expansions of all plans together and the lowest of their best values;
        ``root_counts`` says whether a root may be the best state of its plan.
        """
        lanes = self.lanes = [Lane(self.problem, root, budget, self._expand, root_counts) for root in roots]

        def report(*_: float) -> None:
            if progress is not None:
                progress(sum(len(lane.values) for lane in lanes), max(0.0, min(lane.best[0] for lane in lanes)))

        with terminable():
            if len(lanes) > 1:
                return self._run_together(planner, lanes, report)
            try:
                return [_plan(planner, lanes[0], report)]
            except KeyboardInterrupt as interrupt:  # between two rounds
                self.stopped = _reason(interrupt)
                return [lanes[0].result()]

    def _run_together(self, planner: Any, lanes: list[Lane], report: Progress) -> list[PlanResult]:
        """Run the plans in threads, one at a time and in order: each runs until it asks for expansions or ends."""
        messages: queue.Queue[Request | PlanResult | BaseException] = queue.Queue()
        answers: list[queue.Queue[Sequence[Any]]] = [queue.Queue() for _ in lanes]

        def asks(index: int) -> Ask:
            def ask(asked: Request) -> Sequence[Any]:
                messages.put(asked)
                return answers[index].get()

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
            except Exception as error:  # ends all plans, and is raised when they are over
                failure, states = error, []
            for index, (pairs, _) in asked.items():
                answers[index].put(states[: len(pairs)])
                states = states[len(pairs) :]
                receive(index)
            report(0, 0.0)
        if failure is not None:
            raise failure
        return [results[index] for index in sorted(results)]

    def _expand(self, asked: Request) -> Sequence[Any]:
        """The children of one joint round, from the journal or made now and written there; those of the first pairs
        when the session ends. A time limit bounds a batch to the scenes for which there seems to be time; where a
        planner steers, the children of one parent stay together, as they depend on each other.
        """
        pairs, steering = asked
        how = () if steering is None else (steering,)
        states = [] if self.journal is None or self.stopped else self.journal.take(pairs)
        self._has_begun |= bool(states)
        while len(states) < len(pairs) and not self.stopped:
            begun = time.perf_counter()
            left, rest = self._end - begun, pairs[len(states) :]
            if left < 0 and self._has_begun:
                self.stopped = "time"
                break
            size = len(rest) if math.isinf(left) else max(1, int(left * self._pace)) if self._pace else _FIRST_BATCH
            while how and {id(parent) for parent, _ in rest[:size]} & {id(parent) for parent, _ in rest[size:]}:
                size += 1
            try:
                made = self.problem.expand_batch(rest[:size], *how)
                if self.journal is not None:
                    self.journal.add(made)
            except KeyboardInterrupt as interrupt:
                self.stopped = _reason(interrupt)
                break
            self._has_begun, self._pace = True, len(made) / (time.perf_counter() - begun)
            states += made
        return states


def _reason(interrupt: KeyboardInterrupt) -> str:
    return "terminated" if isinstance(interrupt, Terminated) else "interrupt"


def _plan(planner: Any, lane: Lane, report: Progress | None) -> PlanResult:
    try:
        return planner.plan(lane, lane.budget, report)
    except SearchStoppedError:  # the planner did not catch it
        return lane.result()
