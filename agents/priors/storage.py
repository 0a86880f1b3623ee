"""Priors written to a folder and read again: what of a prior goes into its files."""

from __future__ import annotations

import os
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.diffusion import Preconditioning, ResidualVariance
from agents.priors.files import read_prior, to_precision, write_prior
from scene_envs.errors import CorruptFileError, UnknownNameError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type

if TYPE_CHECKING:
    from agents.priors.base import ScenePrior

PROCESSES = ("continuous", "mixed")
"""Diffusion processes: categories as numbers, or as discrete states."""

_LEVELS, _RESIDUAL = "residual.timesteps", "residual.variance"


def load_prior(name: str | os.PathLike[str]) -> ScenePrior:
    """A shipped prior by name, or one from a prior or run directory; in evaluation mode.

    Raises:
        UnknownNameError: no shipped prior has that name.
        CorruptFileError: its files are not those of a prior, or do not fit each other.
    """
    state, tensors = read_prior(name)
    try:
        moments = Preconditioning.from_state(state["preconditioning"])
        normalizer = Normalizer.from_state(state["normalizer_state"])
        residual = ResidualVariance(tensors.pop(_LEVELS), tensors.pop(_RESIDUAL)) if _LEVELS in tensors else None
        _know_scene_type(state)
        kind = prior_class(state.get("process", "continuous"))
        prior = kind.from_state(state["prior"], normalizer, moments, state.get("card"), residual)
        prior.load_weights(tensors)
    except (KeyError, TypeError) as error:
        raise CorruptFileError(f"the configuration of the prior {str(name)!r} is not one of ours: {error}") from error
    except RuntimeError as error:
        raise CorruptFileError(f"the weights of the prior {str(name)!r} do not fit its network: {error}") from error
    return prior.eval()


def save_prior(prior: ScenePrior, directory: str | os.PathLike[str], precision: str = "float32") -> Path:
    """Write a prior's configuration and weights; arguments as in :meth:`agents.priors.base.ScenePrior.save`."""
    state = {
        "process": prior.process_name,
        "prior": prior.config_state(),
        "scene_type": asdict(prior.scene_type),
        "preconditioning": prior.preconditioning.state(),
        "normalizer_state": prior.normalizer.state(),
        "card": prior.card,
    }
    tensors = to_precision(prior.weights(), precision)
    if prior.residual is not None:
        tensors |= {_LEVELS: prior.residual.timesteps, _RESIDUAL: prior.residual.variance}
    return write_prior(directory, state, tensors)


def prior_class(process: str) -> type[ScenePrior]:
    """The class of priors of one of :data:`PROCESSES`."""
    if process not in PROCESSES:
        raise unknown_name("process", process, PROCESSES)
    kind: type[ScenePrior] = getattr(import_module(f"agents.priors.{process}"), f"{process.capitalize()}Prior")
    return kind


def _know_scene_type(state: dict[str, Any]) -> None:
    """Register the scene type that a prior was saved with, unless one of that name is known."""
    try:
        get_scene_type(state["prior"]["scene_type"])
    except UnknownNameError:
        if "scene_type" not in state:
            raise
        register_scene_type(SceneType.from_dict(state["scene_type"]))
