"""Process group of a training run that ``torchrun``, Accelerate or MPI starts on several processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn

from scene_envs.errors import InvalidInputError, TrainingError

Value = TypeVar("Value")

_LAUNCHERS = {
    "WORLD_SIZE": ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE"),
    "RANK": ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "MV2_COMM_WORLD_RANK"),
    "LOCAL_RANK": ("MPI_LOCALRANKID", "OMPI_COMM_WORLD_LOCAL_RANK", "MV2_COMM_WORLD_LOCAL_RANK"),
}
"""Variables of ``torchrun``, and their names in Intel MPI, Open MPI and MVAPICH."""
TIMEOUT_SECONDS = 600.0
"""Seconds that a process waits for the others."""


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of a run. If one ends or hangs, the others end too: the call in which they wait for it raises a
    :class:`TrainingError`.

    >>> group = ProcessGroup(rank=1, size=2)
    >>> group.rows(6), group.is_first
    (slice(3, 6, None), False)
    """

    rank: int = 0  # index of this process
    size: int = 1  # number of processes; 1 without a launcher

    @classmethod
    def join(cls, device: str = "cpu", timeout: float = TIMEOUT_SECONDS) -> ProcessGroup:
        """The group that the launcher set up, joined on first use; without a launcher, this process alone. Each process
        of ``"cuda"`` takes a GPU of its own; ``timeout`` is in seconds. An InvalidInputError if only ``WORLD_SIZE`` of
        a launcher's variables is set, or if Accelerate was asked for several processes on a CPU, of which it starts
        only one; a TrainingError if the other processes do not join.
        """
        size = launched_processes()
        accelerate = os.environ.get("ACCELERATE_USE_CPU", "").lower() == "true" and "MASTER_ADDR" in os.environ
        if accelerate and _launched_as("WORLD_SIZE") is None:
            raise InvalidInputError(
                "accelerate launch --cpu ignores --num_processes and starts one process; for several on a CPU give "
                "--multi_gpu in place of --cpu, and device=cpu to the command, or use torchrun"
            )
        if size == 1:
            return cls()
        for name in _LAUNCHERS:  # torch reads only the names of torchrun
            if (value := _launched_as(name)) is not None:
                os.environ.setdefault(name, value)
        if device == "cuda":  # each process on a GPU of its own
            torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        if not distributed.is_initialized():
            backend = "cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo"
            try:
                with _distributed_errors():
                    distributed.init_process_group(backend, timeout=timedelta(seconds=timeout))
            except ValueError as error:
                raise InvalidInputError(
                    f"WORLD_SIZE={size} asks for several processes, which cannot connect ({error}); start them with "
                    "torchrun, or unset WORLD_SIZE"
                ) from None
        return cls.current()

    @classmethod
    def current(cls) -> ProcessGroup:
        """The group that was joined; before that, this process alone."""
        if not (distributed.is_available() and distributed.is_initialized()):
            return cls()
        return cls(distributed.get_rank(), distributed.get_world_size())

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and logs."""
        return self.rank == 0

    def rows(self, count: int) -> slice:
        """The rows of this process in a batch of ``count`` rows over all processes."""
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def sum(self, value: Tensor) -> Tensor:
        """The sum of ``value`` over all processes."""
        if self.size > 1:
            value = value.clone()
            with _distributed_errors():
                distributed.all_reduce(value)
        return value

    def sum_numbers(self, *values: float) -> list[float]:
        """The sum of each number over all processes."""
        return list(values) if self.size == 1 else self.sum(torch.tensor(values, dtype=torch.float64)).tolist()

    def any(self, flag: bool) -> bool:
        """Whether ``flag`` is set in at least one process."""
        return self.sum_numbers(float(flag))[0] > 0

    def sum_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace every ``.grad`` by its sum over all processes, in one message; None if it is None in all of them."""
        if self.size == 1:
            return
        taken = list(parameters)
        present = self.sum(torch.tensor([float(p.grad is not None) for p in taken])).tolist()
        taken = [p for p, some in zip(taken, present, strict=True) if some]
        if not taken:
            return
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in taken]
        total = self.sum(torch.cat([gradient.flatten() for gradient in gradients]))
        for parameter, part in zip(taken, total.split([p.numel() for p in taken]), strict=True):
            parameter.grad = part.view_as(parameter).clone()

    def share(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace the values of every process by those of the first."""
        if self.size > 1:
            for parameter in parameters:
                with _distributed_errors():
                    distributed.broadcast(parameter.data, src=0)

    def gather(self, value: Value) -> list[Value]:
        """The ``value`` of every process, in their order; anything that can be pickled."""
        if self.size == 1:
            return [value]
        found: list[Any] = [None] * self.size
        with _distributed_errors():
            distributed.all_gather_object(found, value)
        return found

    def from_first(self, make: Callable[[], Value]) -> Value:
        """In every process, the value that ``make`` returns in the first one."""
        return self.gather(make() if self.is_first else None)[0]  # type: ignore[return-value]

    def wait(self) -> None:
        """Wait until all processes have reached this call."""
        self.sum_numbers(0.0)


def gather_rows(x: Tensor) -> Tensor:
    """``x`` (B, ...) of every process, stacked along rows; ``x`` itself without a process group."""
    size = ProcessGroup.current().size
    if size == 1:
        return x
    parts = [torch.empty_like(x, memory_format=torch.contiguous_format) for _ in range(size)]
    with _distributed_errors():
        distributed.all_gather(parts, x.contiguous())
    return torch.cat(parts)


def launched_processes() -> int:
    """Number of processes that the launcher started; 1 without a launcher."""
    return int(_launched_as("WORLD_SIZE") or "1")


def is_first_process() -> bool:
    """Whether this process writes files and messages: the first of a launcher's processes, or the only one."""
    return int(_launched_as("RANK") or "0") == 0


def _launched_as(name: str) -> str | None:
    """The value of a variable of ``torchrun``, or of the corresponding variable of MPI."""
    return next((os.environ[known] for known in (name, *_LAUNCHERS[name]) if known in os.environ), None)


@contextmanager
def _distributed_errors() -> Iterator[None]:
    """Context that turns the RuntimeErrors of gloo and NCCL into a :class:`TrainingError`."""
    try:
        yield
    except RuntimeError as error:
        raise TrainingError(
            "another process of this run ended or did not answer in time; its output says why, and the same command "
            f"resumes from the last checkpoint ({str(error).splitlines()[0][:200]})"
        ) from error
