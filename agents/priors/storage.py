"""Saving and loading of priors: the contents of their folders."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from agents.diffusion import Preconditioning, ResidualVariance
from agents.priors.files import read_prior, to_precision, write_prior
from scene_envs.errors import CorruptFileError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type

_LEVELS, _RESIDUAL = "residual.timesteps", "residual.variance"


@dataclass(frozen=True)
class StoredPrior:
    """Contents of the files of a prior.

    Attributes:
        process: name of its process.
        fields: what it is made of, as its class reads it.
        scene_type: its scene type.
        normalizer: of raw scenes.
        preconditioning: moments of encoded scenes.
        card: facts about its training.
        residual: measured error of the denoiser, if it was measured.
        tensors: weights by name.
    """

    process: str
    fields: dict[str, Any]
    scene_type: SceneType
    normalizer: Normalizer
    preconditioning: Preconditioning
    card: dict[str, Any]
    residual: ResidualVariance | None
    tensors: dict[str, Tensor]


def read_stored(name: str | os.PathLike[str]) -> StoredPrior:
    """The files of a shipped prior by name, or of one in a prior or run directory; its scene type is registered.

    Raises:
        UnknownNameError: no shipped prior has that name.
        CorruptFileError: a file is truncated or not what its name says.
    """
    state, tensors = read_prior(name)
    with explained(name):
        return StoredPrior(
            preconditioning=Preconditioning.from_state(state["preconditioning"]),
            normalizer=Normalizer.from_state(state["normalizer_state"]),
            residual=ResidualVariance(tensors.pop(_LEVELS), tensors.pop(_RESIDUAL)) if _LEVELS in tensors else None,
            scene_type=_known_scene_type(state),
            process=state.get("process", "continuous"),
            fields=state["prior"],
            card=state.get("card") or {},
            tensors=tensors,
        )


@contextmanager
def explained(name: str | os.PathLike[str]) -> Iterator[None]:
    """Turn errors of what a prior's files hold into CorruptFileErrors that name the prior."""
    try:
        yield
    except (KeyError, TypeError) as error:
        raise CorruptFileError(f"the configuration of the prior {str(name)!r} is not one of ours: {error}") from error
    except RuntimeError as error:
        raise CorruptFileError(f"the weights of the prior {str(name)!r} do not fit its network: {error}") from error


def write_stored(directory: str | os.PathLike[str], stored: StoredPrior, precision: str = "float32") -> Path:
    """Write a prior's configuration and weights, the weights in ``precision`` (``"float32"`` or ``"float16"``)."""
    state = {
        "process": stored.process,
        "prior": stored.fields,
        "scene_type": asdict(stored.scene_type),
        "preconditioning": stored.preconditioning.state(),
        "normalizer_state": stored.normalizer.state(),
        "card": stored.card,
    }
    tensors = to_precision(stored.tensors, precision)
    if stored.residual is not None:
        tensors |= {_LEVELS: stored.residual.timesteps, _RESIDUAL: stored.residual.variance}
    return write_prior(directory, state, tensors)


def _known_scene_type(state: dict[str, Any]) -> SceneType:
    """The scene type that a prior was saved with, which is registered unless one of that name is known."""
    try:
        return get_scene_type(state["prior"]["scene_type"])
    except UnknownNameError:
        if "scene_type" not in state:
            raise
        return register_scene_type(SceneType.from_dict(state["scene_type"]))
