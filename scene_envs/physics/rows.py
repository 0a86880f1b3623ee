"""Records of arrays that share their first axis."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Records = TypeVar("Records", bound="Rows")


class Rows:
    """A dataclass of arrays (n, ...) that are indexed and concatenated together."""

    def __getitem__(self: Records, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Records:
        """The records of ``rows``: integers, or a mask (n,)."""
        return type(self)(*(values[rows] for values in self._columns()))

    def __add__(self: Records, other: Records) -> Records:
        return type(self)(*(np.concatenate(pair) for pair in zip(self._columns(), other._columns(), strict=True)))

    def _columns(self) -> list[Any]:
        return [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
