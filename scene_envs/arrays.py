"""Types of numpy arrays, and ranges of their rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


def ranges(first: Index, counts: Index) -> tuple[Index, Index]:
    """All numbers of the ranges ``first[k] ... first[k] + counts[k] - 1``, after the k of each.

    >>> of, numbers = ranges(np.array([7, 2]), np.array([2, 1]))
    >>> of.tolist(), numbers.tolist()
    ([0, 0, 1], [7, 8, 2])
    """
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) + (first - (np.cumsum(counts) - counts))[of]
