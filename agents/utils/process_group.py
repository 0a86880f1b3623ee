"""Process group of a training run on several processes, as ``torchrun`` starts them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of a run.

    Attributes:
        rank: number of this process.
        size: how many there are; 1 without ``torchrun``.
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def join(cls, device: str = "cpu") -> ProcessGroup:
        """The group that ``torchrun`` set up, joined on first use; this process alone without it."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size == 1:
            return cls()
        if device == "cuda":  # each process on a GPU of its own
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        if not torch.distributed.is_initialized():
            torch.distributed.init_process_group("nccl" if device.startswith("cuda") else "gloo")
        return cls(torch.distributed.get_rank(), size)

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and logs."""
        return self.rank == 0

    def sum(self, value: Tensor) -> Tensor:
        """The sum of ``value`` over all processes."""
        if self.size > 1:
            value = value.clone()
            torch.distributed.all_reduce(value)
        return value

    def sum_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace every ``.grad`` by its sum over all processes, in one message."""
        if self.size == 1:
            return
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        flat = self.sum(torch.cat([gradient.flatten() for gradient in gradients]))
        for gradient, total in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(total.view_as(gradient))

    def share(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace the values of every process by those of the first."""
        if self.size > 1:
            for parameter in parameters:
                torch.distributed.broadcast(parameter.data, src=0)

    def wait(self) -> None:
        """Go on when all processes are here."""
        if self.size > 1:
            torch.distributed.barrier()


def gather_rows(x: Tensor) -> Tensor:
    """``x`` (B, ...) of every worker, stacked along rows; ``x`` itself without ``torch.distributed``."""
    distributed = torch.distributed
    if not (distributed.is_available() and distributed.is_initialized()) or distributed.get_world_size() == 1:
        return x
    parts = [torch.empty_like(x) for _ in range(distributed.get_world_size())]
    distributed.all_gather(parts, x.contiguous())
    return torch.cat(parts)


def is_first_process() -> bool:
    """Whether this process, of those that ``torchrun`` started, is the one that writes files and speaks."""
    return int(os.environ.get("RANK", "0")) == 0
