"""Torch devices by name."""

from __future__ import annotations

import torch

from scene_envs.errors import InvalidInputError


def check_device(name: str) -> None:
    """Raise unless torch knows the device and this machine has it.

    Raises:
        InvalidInputError: the device cannot be used; the message says which would work.

    >>> check_device("cpu")
    """
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except Exception:  # each backend has errors of its own
        here = ["cpu"]
        here += [f"cuda:{index}" for index in range(torch.cuda.device_count())]
        raise InvalidInputError(
            f"device={str(name)[:60]!r} is not a torch device of this machine; use one of {', '.join(here)}"
        ) from None
    if device.type == "meta":
        raise InvalidInputError("device='meta' stores no data; give cpu or cuda")
