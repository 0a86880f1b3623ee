"""Seeds of the global random generators while a reward runs."""

from __future__ import annotations

import hashlib
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from scene_envs.scene import SceneBatch

_local = threading.local()


@contextmanager
def seeded_generators(seed: int, batch: SceneBatch | None = None) -> Iterator[None]:
    """Context in which the generators of torch (CPU), NumPy and Python start from a seed of their own.

    That seed depends only on ``seed``, the scenes and :func:`current_draw`. The same scenes get the same numbers in
    every call, in every process, and after a run is resumed. Afterwards the generators go on as if nothing had been
    drawn.

    Args:
        seed: seed of the run.
        batch: the scenes that are scored; None while the reward is made.
    """
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    scenes = b"" if batch is None else batch.tensor.detach().cpu().contiguous().numpy().tobytes()
    digest = hashlib.blake2b(scenes, digest_size=8)
    digest.update(f"{seed} {current_draw()}".encode())
    number = int.from_bytes(digest.digest(), "little")
    torch.default_generator.manual_seed(number >> 1)
    np.random.seed(number % 2**32)  # noqa: NPY002
    random.seed(number)
    try:
        yield
    finally:
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])


@contextmanager
def other_draw(number: int) -> Iterator[None]:
    """Context in which rewards get other random numbers; each ``number`` has its own stream, and 0 is the usual one."""
    before = current_draw()
    _local.draw = number
    try:
        yield
    finally:
        _local.draw = before


def current_draw() -> int:
    """The stream of random numbers that this thread's rewards get."""
    return int(getattr(_local, "draw", 0))
