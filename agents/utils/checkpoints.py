"""Resumable state on disk: written whole or not at all, read without running anything."""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from scene_envs.errors import CorruptFileError, InvalidInputError, TrainingError
from scene_envs.files import replacing


def save_checkpoint(path: str | os.PathLike[str], state: dict[str, Any]) -> None:
    """Write ``state`` (tensors, numbers, strings, containers) to ``path``, replacing it atomically.

    Raises:
        TrainingError: the disk refused; the previous checkpoint is untouched.
    """
    try:
        with replacing(path) as partial, partial.open("wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
    except (OSError, RuntimeError) as error:
        raise TrainingError(
            f"could not write the checkpoint {str(path)!r} ({error}); the previous one is intact: "
            "free some space and run the same command again to resume"
        ) from error


def load_checkpoint(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a checkpoint, weights only: no code in the file is run.

    Raises:
        CorruptFileError: truncated, or not a checkpoint.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InvalidInputError(f"no checkpoint at {str(path)!r}") from None
    except (RuntimeError, EOFError, pickle.UnpicklingError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CorruptFileError(
            f"{str(path)!r} is truncated or not a checkpoint ({reason}); delete it to start the run anew"
        ) from error
    if not isinstance(state, dict):
        raise CorruptFileError(f"{str(path)!r} holds a {type(state).__name__}, not a checkpoint")
    return state


def check_tensors(module: nn.Module, tensors: Mapping[str, Tensor], path: str | os.PathLike[str]) -> None:
    """Refuse weights of a checkpoint whose names and shapes are not those of ``module``.

    Args:
        module: what is to be restored.
        tensors: its state dict in the checkpoint.
        path: the checkpoint, for the message.

    Raises:
        InvalidInputError: a tensor is missing, unknown or of another shape, as in runs that an earlier version began.
    """
    wanted, found = ({name: x.shape for name, x in each.items()} for each in (module.state_dict(), tensors))
    differing = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    if differing:
        raise InvalidInputError(
            f"{str(path)!r} cannot be resumed: {len(differing)} of its tensors are not those of the network here, the "
            f"first {differing[0]!r}; an earlier version of SceneEnvs or another prior began the run: go on with that "
            "one, or give another output to start anew"
        )
