"""Types of numpy arrays, ranges of their rows, devices by name, and work in their memory; torch is not imported."""

from __future__ import annotations

import re
from collections.abc import Callable, MutableMapping
from functools import cache
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    import torch
    from torch import Tensor

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]
Result = TypeVar("Result")


def ranges(first: Index, counts: Index) -> tuple[Index, Index]:
    """All numbers of the ranges ``first[k] ... first[k] + counts[k] - 1``, after the k of each.

    >>> of, numbers = ranges(np.array([7, 2]), np.array([2, 1]))
    >>> of.tolist(), numbers.tolist()
    ([0, 0, 1], [7, 8, 2])
    """
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) + (first - (np.cumsum(counts) - counts))[of]


def resolve_device(name: str | torch.device, auto: torch.device | None = None) -> torch.device:
    """The torch device of a name such as ``cpu``, ``cuda`` or ``cuda:1``.

    ``"auto"`` is ``auto``, the device of something that exists already, or else the GPU where torch finds one and the
    CPU where it finds none.

    Raises:
        InvalidInputError: this machine has no such device; the message says which it has.

    >>> str(resolve_device("cpu"))
    'cpu'
    """
    import torch

    if name == "auto":
        return auto or torch.device("cuda" if torch.cuda.is_available() else "cpu")
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    try:
        device = torch.device(name)
        if device.type == "cuda":  # without a context on it: each process of a run has a GPU of its own
            usable = (device.index or 0) < count
        else:
            usable = device.type == "cpu" or torch.empty(1, device=device).device.type != "meta"  # which stores no data
    except Exception:  # each backend has errors of its own
        usable = False
    if not usable:
        here = ", ".join(["auto", "cpu", *["cuda"][:count], *(f"cuda:{index}" for index in range(count))])
        found = "" if count else "; torch finds no CUDA GPU"
        raise InvalidInputError(f"device={str(name)[:60]!r} is no device of this machine; use one of {here}{found}")
    return device


@cache
def _copies() -> MutableMapping[Tensor, dict[torch.device, Tensor]]:
    from torch.utils.weak import WeakTensorKeyDictionary

    return WeakTensorKeyDictionary()


def constant_on(constant: Tensor, device: torch.device) -> Tensor:
    """A tensor that is never written to, on ``device``; it is copied there once, not at every use."""
    if constant.device == device:
        return constant
    copies = _copies().setdefault(constant, {})
    if device not in copies:
        import torch

        with torch.inference_mode(False):  # a copy that serves where gradients are recorded, too
            copies[device] = constant.to(device)
    return copies[device]


def within_memory(work: Callable[[int], Result], size: int, key: str) -> Result:
    """``work(size)``, where ``size`` scenes are computed at once, as ``key`` says.

    Raises:
        InvalidInputError: the memory is too small; the message gives the largest half, quarter, ... of ``size`` with
            which ``work`` ends.
    """
    reason, fits = "", size
    while fits:
        try:
            found = work(fits)
            break
        except (MemoryError, RuntimeError) as error:
            reason = reason or (str(error).splitlines() or [type(error).__name__])[0][:200]
            if not (isinstance(error, MemoryError) or re.search("out of memory|can't allocate memory", str(error))):
                raise
        fits //= 2  # out of the clause above, which holds the tensors of the attempt
    if fits == size:
        return found
    advice = f"{key}={fits} fits" if fits else "not even one fits"
    raise InvalidInputError(f"{key}={size} needs more memory than the device has ({reason}); {advice}")
