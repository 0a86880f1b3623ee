"""Disjoint parts of a dataset that never share a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from scene_envs.datasets.layout import mix_bits
from scene_envs.errors import InvalidInputError

Keys = NDArray[np.uint64]


@dataclass(frozen=True)
class Part:
    """One of several disjoint parts of a dataset, decided scene by scene from the scene's key.

    A scene stays in its part when the dataset grows or is read in another order. Rows that repeat a scene share its
    part. The fractions are therefore only met on average.

    Attributes:
        fractions: Fractions of all parts, in order; they may sum to less than one.
        index: Index of this part.
        seed: Seed of the assignment, not negative.

    Raises:
        InvalidInputError: fractions, index or seed are not as described above.

    >>> keys = mix_bits(np.arange(10_000, dtype=np.uint64))
    >>> train, test = (Part((0.9, 0.1), index).contains(keys) for index in (0, 1))
    >>> int((train & test).sum()), int((train | test).sum()), abs(int(test.sum()) - 1000) < 150
    (0, 10000, True)
    """

    fractions: tuple[float, ...]
    index: int
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "fractions", check_fractions(self.fractions))
        if not 0 <= self.index < len(self.fractions):
            raise InvalidInputError(
                f"there is no part {self.index} of {len(self.fractions)} parts; index goes from 0 to "
                f"{len(self.fractions) - 1}"
            )
        if self.seed < 0:
            raise InvalidInputError(f"a part needs seed >= 0, got {self.seed}")

    def contains(self, keys: Keys) -> NDArray[np.bool_]:
        """(M,) bool, True for scenes, given by their keys, that are in this part."""
        draws = mix_bits(keys ^ mix_bits(np.array([self.seed], dtype=np.uint64))) / 2.0**64  # (M,) in [0, 1]
        bounds = list(accumulate(self.fractions, initial=0.0))
        low, high = bounds[self.index], bounds[self.index + 1]
        return (draws >= low) & ((draws < high) | (high >= 1 - 1e-9))


def check_fractions(fractions: Sequence[float]) -> tuple[float, ...]:
    """The fractions; raises InvalidInputError when one is negative or they sum to more than one."""
    if not len(fractions) or any(fraction < 0 for fraction in fractions) or sum(fractions) > 1 + 1e-9:
        raise InvalidInputError(f"fractions must be >= 0 and sum to at most 1, got {list(fractions)}")
    return tuple(float(fraction) for fraction in fractions)


def split_rows(keys: Keys, fractions: Sequence[float], seed: int) -> list[NDArray[np.int64]]:
    """Rows of disjoint random parts; sizes are exact where no scene repeats, rows of one scene stay together."""
    check_fractions(fractions)
    if seed < 0:
        raise InvalidInputError(f"a split needs seed >= 0, got {seed}")
    _, first, group, sizes = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    shuffled = np.argsort(first)[np.random.default_rng(seed).permutation(len(sizes))]  # groups, in random order
    ends = np.cumsum(sizes[shuffled])
    position = np.empty(len(sizes), dtype=np.int64)  # position of a group's last row in the shuffled order
    position[shuffled] = ends
    order = np.argsort(position[group], kind="stable")
    edges = [round(bound * len(keys)) for bound in accumulate(fractions, initial=0.0)]
    whole = [int(ends[np.searchsorted(ends, edge)]) if edge > 0 else 0 for edge in edges]
    return [order[low:high] for low, high in pairwise(whole)]
