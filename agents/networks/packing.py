"""Packing of scenes: slots that are known to be empty are left out of a network's batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

_CHUNKS = 4
"""Parts of a batch on the CPU, each as wide as its fullest scene."""


def pack(active: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Parts of a batch: scenes with similar numbers of active slots, and which of their slots to keep.

    Args:
        active: (B, N) bool, slots that take part.

    Yields:
        rows (b,) int64 of the part, index (b, M) int64 of its slots with the active ones first, and mask (b, M) bool
        that is False on padding. Every scene is in one part. M is the largest number of active slots of a scene in the
        part, at least 1.
    """
    counts = active.sum(dim=1)
    chunks = _CHUNKS if active.device.type == "cpu" and len(active) >= 4 * _CHUNKS else 1
    for rows in torch.argsort(counts, stable=True).tensor_split(chunks):
        width = max(1, int(counts[rows].max()))
        index = torch.argsort(~active[rows], dim=1, stable=True)[:, :width]
        yield rows, index, active[rows].gather(1, index)


def run_packed(
    active: Tensor, run: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]], widths: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """The two outputs of ``run`` on the active slots, (B, N, W) each, with zeros elsewhere.

    Args:
        active: (B, N) bool.
        run: from rows, index and mask, as :func:`pack` yields them, to two tensors (b, M, W).
        widths: W of the two outputs.
    """
    parts, order = [], []
    for rows, index, mask in pack(active):
        order.append(rows)
        parts.append(
            [_spread(part * mask[..., None], index, active.shape[1], width)
             for part, width in zip(run(rows, index, mask), widths, strict=True)]
        )  # fmt: skip
    back = torch.argsort(torch.cat(order))
    first, second = (torch.cat([part[side] for part in parts])[back] for side in (0, 1))
    return first, second


def take_slots(x: Tensor, rows: Tensor, index: Tensor) -> Tensor:
    """(b, M, ...) slots ``index`` (b, M) of the scenes ``rows`` of x (B, N, ...)."""
    return x[rows[:, None], index]


def _spread(values: Tensor, index: Tensor, slots: int, width: int) -> Tensor:
    """(b, slots, width) with ``values`` (b, M, width) at ``index``."""
    empty = values.new_zeros(len(values), slots, width)
    return empty.scatter(1, index[..., None].expand(-1, -1, width), values)
