"""Saving and loading of priors: the contents of their folders."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from agents.diffusion import Preconditioning, ResidualVariance
from agents.prior_names import find_prior
from agents.priors.files import read_prior, to_precision, write_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type

logger = logging.getLogger(__name__)

ASSET_FOLDERS = "SCENE_ENVS_ASSET_FOLDERS"
"""Environment variable with the folders of assets that priors from elsewhere may read."""
_LIMITS = {"slots": 10_000, "num_timesteps": 1_000_000, "seed": 2**63}
_LEVELS, _RESIDUAL = "residual.timesteps", "residual.variance"


@dataclass(frozen=True)
class StoredPrior:
    """Contents of the files of a prior.

    Attributes:
        process: name of its process.
        fields: its configuration, as its class reads it.
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
        check_sizes(state["prior"], sum(tensor.numel() for tensor in tensors.values()), name)
        return StoredPrior(
            preconditioning=Preconditioning.from_state(state["preconditioning"]),
            normalizer=Normalizer.from_state(state["normalizer_state"]),
            residual=ResidualVariance(tensors.pop(_LEVELS), tensors.pop(_RESIDUAL)) if _LEVELS in tensors else None,
            scene_type=_known_scene_type(state, find_prior(name)),
            process=state.get("process", "continuous"),
            fields=state["prior"],
            card=state.get("card") or {},
            tensors=tensors,
        )


@contextmanager
def explained(name: str | os.PathLike[str]) -> Iterator[None]:
    """Make errors about the content of a prior's files name the prior; Python's own become CorruptFileErrors."""
    try:
        yield
    except (InvalidInputError, UnknownNameError) as error:
        if str(name) in str(error):
            raise
        raise type(error)(f"prior {str(name)!r}: {error}") from error
    except SceneEnvsError:
        raise
    except RuntimeError as error:
        raise CorruptFileError(
            f"the weights of the prior {str(name)!r} do not fit its network: {_cut(error)}"
        ) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise CorruptFileError(
            f"the configuration of the prior {str(name)!r} is not one of ours: {type(error).__name__}: {_cut(error)}"
        ) from error


def _cut(error: BaseException) -> str:
    return str(error)[:500]


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


def _known_scene_type(state: dict[str, Any], directory: Path) -> SceneType:
    """The scene type that a prior was saved with; it is registered unless its name is already known.

    Of its folders of assets, only those inside the prior's own folder, or inside a folder that the user named in
    ``ASSET_FOLDERS``, are read.
    """
    try:
        return get_scene_type(state["prior"]["scene_type"])
    except UnknownNameError:
        if "scene_type" not in state:
            raise
        found = SceneType.from_dict(state["scene_type"])
        named = [Path(name).expanduser() for name in os.environ.get(ASSET_FOLDERS, "").split(os.pathsep) if name]
        allowed = [folder.resolve() for folder in (directory, *named)]
        kept = tuple(
            folder for folder in found.asset_folders if any(map(Path(folder).resolve().is_relative_to, allowed))
        )
        left = [folder for folder in found.asset_folders if folder not in kept]
        if left:
            logger.warning(
                "the prior %r names folders of assets outside its own, which are not read: %s; to read them, name "
                "them in the environment variable %s, separated by %r",
                str(directory),
                ", ".join(left)[:500],
                ASSET_FOLDERS,
                os.pathsep,
            )
        return register_scene_type(replace(found, asset_folders=kept))


def check_sizes(fields: Any, weights: int, name: str | os.PathLike[str]) -> None:
    """Refuse a configuration that asks for a network larger than the weights in its file, before anything is built.

    Args:
        fields: the configuration, nested.
        weights: how many numbers the file holds.
        name: of the prior, for the message.

    Raises:
        CorruptFileError: a size is out of proportion.
    """
    sizes = list(_sizes(fields, ""))
    room = 64 * (weights + 100_000)
    wide = max([size for key, size in sizes if key not in _LIMITS], default=1)
    deep = max([size for key, size in sizes if key == "depth"], default=1)
    for key, size in sizes:
        most = _LIMITS.get(key, int((room / (deep if size == wide and key != "depth" else 1)) ** 0.5))
        if abs(size) > most:
            raise CorruptFileError(
                f"the configuration of the prior {str(name)!r} asks for {key}={size}, beyond what its file of "
                f"{weights} weights can have ({most})"
            )


def _sizes(fields: Any, key: str) -> Iterator[tuple[str, int]]:
    if isinstance(fields, dict):
        for name, value in fields.items():
            yield from _sizes(value, str(name))
    elif isinstance(fields, list):
        for value in fields:
            yield from _sizes(value, key)
    elif isinstance(fields, int) and not isinstance(fields, bool):
        yield key, fields
