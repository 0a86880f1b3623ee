"""Checkpoints on disk, written atomically and read without running code in the file.

Seeds of independent random streams are derived from keys, so that a resumed run needs no state of a generator.
"""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor, nn

from scene_envs.errors import CorruptFileError, InvalidInputError, TrainingError
from scene_envs.files import replacing

_MARK = b"scene-envs sha256 "
_TRAILER = len(_MARK) + 64
"""The last bytes of a checkpoint: the mark, and the digest of all bytes before it in hexadecimal."""


def save_checkpoint(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write ``state`` (tensors, numbers, strings, containers) to ``path``, replacing it atomically; a TrainingError
    leaves the previous checkpoint untouched.
    """
    try:
        with replacing(path) as partial, partial.open("w+b") as file:
            torch.save(state, file)
            file.seek(0)
            digest = hashlib.sha256()
            while block := file.read(1 << 20):
                digest.update(block)
            file.write(_MARK + digest.hexdigest().encode())
            file.flush()
            os.fsync(file.fileno())
    except (OSError, RuntimeError) as error:
        raise TrainingError(
            f"could not write the checkpoint {str(path)!r} ({error}); the previous one is intact: "
            "free some space and run the same command again to resume"
        ) from error


def load_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a checkpoint, weights only: no code in the file is run. A CorruptFileError if it is truncated, damaged, or
    no checkpoint.
    """
    try:
        with open(path, "rb") as file:
            content = file.read()
    except FileNotFoundError:
        raise InvalidInputError(f"no checkpoint at {str(path)!r}") from None
    if content[-_TRAILER:].startswith(_MARK):
        content, written = content[:-_TRAILER], content[-64:].decode(errors="replace")
        if hashlib.sha256(content).hexdigest() != written:
            raise CorruptFileError(
                f"{str(path)!r} is damaged (checksum of another content); delete it to start the run anew"
            )
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file may raise anything; torch's own message advises to run its code
        raise CorruptFileError(
            f"{str(path)!r} is truncated or not a checkpoint ({type(error).__name__}); delete it to start the run anew"
        ) from error
    if not isinstance(state, dict):
        raise CorruptFileError(f"{str(path)!r} holds a {type(state).__name__}, not a checkpoint")
    return state


def check_tensors(module: nn.Module, tensors: Mapping[str, Tensor], path: str | os.PathLike[str]) -> None:
    """Raise InvalidInputError unless the ``tensors`` of a checkpoint have names and shapes of those of ``module``."""
    wanted, found = ({name: x.shape for name, x in each.items()} for each in (module.state_dict(), tensors))
    differing = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    if differing:
        raise InvalidInputError(
            f"{str(path)!r} cannot be resumed: {len(differing)} of its tensors are not those of the network here, the "
            f"first {differing[0]!r}; the run began with another prior: go on with that one, or give another output to "
            "start anew"
        )


def derived_seed(*key: int) -> int:
    """A seed below 2^31 that depends on all numbers of ``key``, such as (seed, purpose, iteration); none is negative.

    >>> derived_seed(0, 1) != derived_seed(1, 0)
    True
    """
    return int(np.random.SeedSequence(key).generate_state(1)[0]) >> 1


def derived_generator(*key: int) -> Generator:
    """A CPU generator with a seed below 2^63 that depends on all numbers of ``key``, none of them negative."""
    return Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0]) >> 1)
