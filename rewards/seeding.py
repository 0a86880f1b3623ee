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
    """Context in which the generators of torch (CPU), NumPy and Python have a seed that depends on the scenes.

    The seed depends only on ``seed``, the scenes and :func:`current_draw`, so the same scenes get the same numbers in
    every call, in every process, and after a run is resumed. Afterwards the generators have their earlier states.

    Args:
        seed: seed of the run.
        batch: scenes that are scored; None while the reward is made.
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
    """Context in which rewards draw from the stream ``number`` of random numbers; the default stream is 0."""
    before = current_draw()
    _local.draw = number
    try:
        yield
    finally:
        _local.draw = before


def current_draw() -> int:
    """Number of the stream of random numbers of this thread's rewards."""
    return int(getattr(_local, "draw", 0))
