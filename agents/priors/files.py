"""Files of priors: configuration, weights and measured error on disk, and facts about a prior for a listing."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from agents.configuration.prior_names import CONFIG_NAME, find_prior
from agents.diffusion import Preconditioning, ResidualVariance
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError, UnknownNameError, unknown_name
from scene_envs.files import read_json, read_tensors, with_digest, write_json, write_tensors
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type

_LOGGER = logging.getLogger(__name__)

WEIGHTS_NAME = "model.safetensors"
RESIDUAL = "residual."
"""Prefix of the names of measured tensors, which are not weights."""
_LEVELS, _VARIANCE = f"{RESIDUAL}timesteps", f"{RESIDUAL}variance"
PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
"""Number formats of the weights in a file."""
ASSET_FOLDERS = "SCENE_ENVS_ASSET_FOLDERS"
"""Environment variable with the folders of assets that priors from elsewhere may read."""
_LIMITS = {"slots": 10_000, "num_timesteps": 1_000_000, "seed": 2**63}


def to_precision(weights: Mapping[str, Tensor], precision: str) -> dict[str, Tensor]:
    """Weights in the number format of a file, ``"float32"`` or ``"float16"``; half precision keeps 11 bits, a relative
    error of at most 2^-11. An UnknownNameError for another format, an InvalidInputError for a weight beyond its range.

    >>> to_precision({"bias": torch.tensor([0.1])}, "float16")["bias"].dtype
    torch.float16
    """
    if precision not in PRECISIONS:
        raise unknown_name("precision", precision, PRECISIONS)
    kind = PRECISIONS[precision]
    for name, tensor in weights.items():
        if tensor.is_floating_point() and bool((tensor.abs() > torch.finfo(kind).max).any()):
            raise InvalidInputError(
                f"weight {name!r} reaches {float(tensor.abs().max()):.3g}, beyond the {torch.finfo(kind).max:.3g} of "
                f"{precision}; save the prior with precision='float32'"
            )
    return {name: tensor.to(kind) if tensor.is_floating_point() else tensor for name, tensor in weights.items()}


def write_config(directory: Path, config: Mapping[str, Any]) -> None:
    """Replace a prior's configuration atomically; it carries a digest."""
    write_json(directory / CONFIG_NAME, with_digest(config))


def read_config(name: str | os.PathLike[str]) -> dict[str, Any]:
    """Configuration of a prior, compared with its digest and returned without it; errors as for :func:`read_prior`."""
    return read_json(find_prior(name) / CONFIG_NAME)


def count_parameters(name: str | os.PathLike[str]) -> int:
    """Number of trained parameters of a prior, without reading its weights; errors as for :func:`read_prior`."""
    with _weights_of(name) as file, safe_open(file, "pt") as tensors:
        shapes = [tensors.get_slice(key).get_shape() for key in tensors.keys() if not key.startswith(RESIDUAL)]  # noqa: SIM118
    return sum(math.prod(shape) for shape in shapes)


def read_prior(name: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Configuration and weights of a prior, floats in float32 for every number format of the file.

    Raises:
        UnknownNameError: no shipped prior has that name (the nearest one is offered).
        CorruptFileError: a file is truncated or not what its name says.
    """
    config = read_config(name)
    with _weights_of(name) as file:
        tensors, _ = read_tensors(file)
    return config, {key: value.float() if value.is_floating_point() else value for key, value in tensors.items()}


@contextmanager
def _weights_of(name: str | os.PathLike[str]) -> Iterator[Path]:
    """The path of a prior's weights; errors while the weights are read become errors of this package."""
    directory = find_prior(name)
    weights = directory / WEIGHTS_NAME
    try:
        yield weights
    except FileNotFoundError:
        raise CorruptFileError(f"the prior at {str(directory)!r} lacks its weights, {WEIGHTS_NAME}") from None
    except SafetensorError as error:
        raise CorruptFileError(
            f"{str(weights)!r} is truncated or not a safetensors file ({error}); copy it again or train anew"
        ) from error


# -- whole priors ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoredPrior:
    """Contents of the files of a prior."""

    process: str
    fields: dict[str, Any]  # its configuration, as its class reads it
    scene_type: SceneType
    normalizer: Normalizer  # of raw scenes
    preconditioning: Preconditioning  # moments of encoded scenes
    card: dict[str, Any]  # facts about its training
    residual: ResidualVariance | None  # measured error of the denoiser
    tensors: dict[str, Tensor]  # weights


def read_stored(name: str | os.PathLike[str]) -> StoredPrior:
    """The files of a shipped prior by name, or of one in a prior or run directory; its scene type is registered. Errors
    are those of :func:`read_prior`.
    """
    state, tensors = read_prior(name)
    with explained(name):
        check_sizes(state["prior"], sum(tensor.numel() for tensor in tensors.values()), name)
        return StoredPrior(
            preconditioning=Preconditioning.from_state(state["preconditioning"]),
            normalizer=Normalizer.from_state(state["normalizer_state"]),
            residual=ResidualVariance(tensors.pop(_LEVELS), tensors.pop(_VARIANCE)) if _LEVELS in tensors else None,
            scene_type=_known_scene_type(state, find_prior(name)),
            process=state["process"],
            fields=state["prior"],
            card=state["card"],
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
            f"the weights of the prior {str(name)!r} do not fit its network: {str(error)[:500]}"
        ) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise CorruptFileError(
            f"the configuration of the prior {str(name)!r} is not one of ours: {type(error).__name__}: "
            f"{str(error)[:500]}"
        ) from error


def write_stored(directory: str | os.PathLike[str], stored: StoredPrior, precision: str = "float32") -> Path:
    """Write a prior's configuration, and its weights in ``precision`` (see :func:`to_precision`), each atomically."""
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
        tensors |= {_LEVELS: stored.residual.timesteps, _VARIANCE: stored.residual.variance}
    folder = Path(directory)
    write_tensors(folder / WEIGHTS_NAME, tensors)
    write_config(folder, state)
    return folder


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
            _LOGGER.warning(
                "the prior %r names folders of assets outside its own, which are not read: %s; to read them, name "
                "them in the environment variable %s, separated by %r",
                str(directory),
                ", ".join(left)[:500],
                ASSET_FOLDERS,
                os.pathsep,
            )
        return register_scene_type(replace(found, asset_folders=kept))


def check_sizes(fields: Any, weights: int, name: str | os.PathLike[str]) -> None:
    """Raise CorruptFileError if nested ``fields`` ask for a network larger than the number of ``weights`` in its file.

    Nothing has been built by then.
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


# -- facts ----------------------------------------------------------------------------------------


HEADLINES = {
    "feasible_fraction": "free objects feasible as sampled",
    "ready_fraction": "after projection and settling",
    "classifier_accuracy": "told from real scenes by a classifier",
    "prompt_following": "prompts followed",
    "novelty": "novelty",
}
"""The figures of :mod:`agents.evaluation` that a listing shows, and their labels."""


@dataclass(frozen=True)
class PriorFacts:
    """Facts about a prior from its files."""

    name: str  # or path, under which the prior was asked for
    scene_type: str
    process: str  # ``"continuous"`` or ``"mixed"``
    slots: int  # per scene, in training
    text: str  # description of its text encoder; empty for a prior without text
    parameters: int  # number of trained ones in its file
    megabytes: float  # of its weights on disk, MB
    card: Mapping[str, Any]  # facts about its training and, under ``measures``, its figures

    @classmethod
    def of(cls, name: str | os.PathLike[str]) -> PriorFacts:
        """The facts of a shipped prior, or of one in a prior or run directory; weights are not read. Errors are as for
        :func:`read_prior`.
        """
        folder, state = find_prior(name), read_config(name)
        with explained(name):
            made = state["prior"]
            return cls(
                name=str(name),
                scene_type=made["scene_type"],
                process=state["process"],
                slots=made["slots"],
                text=_reader(made.get("text")),
                parameters=count_parameters(name),
                megabytes=(folder / WEIGHTS_NAME).stat().st_size / 1e6,
                card=state["card"],
            )

    @property
    def measures(self) -> dict[str, float]:
        """The figures of its samples; empty when it was never measured."""
        return dict(self.card.get("measures") or {})

    def lines(self) -> list[str]:
        """A few lines for a listing."""
        prompts = f"reads prompts with {self.text}" if self.text else "reads no prompts"
        head = f"{self.name}: scenes of {self.scene_type}, {self.slots} slots, {self.process} process, {prompts}"
        rows = [f"{self.parameters / 1e6:.1f} M parameters, {self.megabytes:.1f} MB"]
        shown = headlines(self.measures)
        width = max((len(label) for label, _, _ in shown), default=0)
        rows += [
            f"{label:{width}}  {value:>6}{f'  (real scenes {real})' if real else ''}" for label, value, real in shown
        ]
        return [head, *(f"    {row}" for row in (rows if shown else [*rows, "not measured"]))]


def headlines(measures: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """(label, samples, real scenes) of the figures that a listing shows; figures that were not measured are left out.

    >>> headlines({"feasible_fraction": 0.81, "floor_feasible_fraction": 0.99, "novelty": 0.954})
    [('free objects feasible as sampled', '81 %', '99 %'), ('novelty', '0.95', '')]
    """
    return [
        (label, _figure(name, measures[name]), _figure(name, measures.get(f"floor_{name}")))
        for name, label in HEADLINES.items()
        if name in measures
    ]


def _reader(text: Mapping[str, Any] | None) -> str:
    if text is None:
        return ""
    if text.get("kind") == "bert":
        return f"BERT ({os.path.basename(text['model'])})"
    return f"a vocabulary of {len(text['words'])} words"


def _figure(name: str, value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if name == "novelty" else f"{100 * value:.3g} %"
