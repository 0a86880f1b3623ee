"""Small deterministic trees for planners, whose states are paths."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

Path = tuple[int, ...]


class ToyTree:
    """States are paths; values come from a function of the path; ``batches`` holds the sizes of the expansions."""

    def __init__(self, value, branching: int = 3, depth: int = 4, broken: frozenset[Path] = frozenset()) -> None:
        self.value, self.branching, self.depth, self.broken = value, branching, depth, broken
        self.batches: list[int] = []

    def clone_state(self) -> Path:
        return ()

    def legal_actions(self, state: Path) -> Sequence[int]:
        return range(self.branching) if len(state) < self.depth else ()

    def expand_batch(self, pairs: Sequence[tuple[Path, int]]) -> list[Path]:
        self.batches.append(len(pairs))
        return [(*state, action) for state, action in pairs]

    def evaluate(self, state: Path) -> float:
        return math.nan if state in self.broken else self.value(state)

    def all_paths(self) -> list[Path]:
        levels = range(1, self.depth + 1)
        return [path for n in levels for path in itertools.product(range(self.branching), repeat=n)]


def scrambled(path: Path) -> float:
    """A value in [0, 1) with no structure."""
    return (sum((a + 1) * 7919 ** (i + 1) for i, a in enumerate(path)) % 1009) / 1009


def matches(target: Path):
    """The share of ``target`` that a path gets right from the left: greedy steps pay, as in scene repair."""

    def value(path: Path) -> float:
        right = next((i for i, (a, b) in enumerate(zip(path, target, strict=False)) if a != b), len(path))
        return right / len(target)

    return value
