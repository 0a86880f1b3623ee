"""Locations of priors on disk: names, directories, safetensors and their configuration."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from agents.prior_names import CONFIG_NAME, find_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.files import with_digest, without_digest, write_json
from scene_envs.tensor_files import read_tensors, write_tensors

WEIGHTS_NAME = "model.safetensors"
RESIDUAL = "residual."
"""Prefix of the names of measured tensors, which are not weights."""
PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
"""Number formats of the weights in a file."""


def to_precision(weights: Mapping[str, Tensor], precision: str) -> dict[str, Tensor]:
    """Weights in the number format of a file; half precision keeps 11 bits, a relative error of at most 2^-11.

    Args:
        weights: trained tensors by name.
        precision: ``"float32"`` or ``"float16"``.

    Raises:
        UnknownNameError: another format.
        InvalidInputError: a weight beyond the range of the format (its tensor is named).

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


def write_prior(directory: str | os.PathLike[str], config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Path:
    """Write a prior's configuration and weights, each file atomically."""
    directory = Path(directory)
    write_tensors(directory / WEIGHTS_NAME, tensors)
    write_config(directory, config)
    return directory


def write_config(directory: Path, config: Mapping[str, Any]) -> None:
    """Replace a prior's configuration atomically; it carries a digest."""
    write_json(directory / CONFIG_NAME, with_digest(config))


def read_config(name: str | os.PathLike[str]) -> dict[str, Any]:
    """Configuration of a prior, compared with its digest and returned without it; errors as for :func:`read_prior`."""
    file = find_prior(name) / CONFIG_NAME
    try:
        config: dict[str, Any] = json.loads(file.read_text())
    except (ValueError, RecursionError) as error:
        raise CorruptFileError(
            f"{str(file)!r} is not valid JSON: {type(error).__name__}: {str(error)[:200]}"
        ) from error
    if not isinstance(config, dict):
        raise CorruptFileError(f"{str(file)!r} holds no mapping, so it is not the configuration of a prior")
    return without_digest(config, file)


def count_parameters(name: str | os.PathLike[str]) -> int:
    """Number of trained parameters of a prior, without reading its weights; errors as for :func:`read_prior`."""
    with _weights_of(name) as file, safe_open(file, "pt") as tensors:
        shapes = [tensors.get_slice(key).get_shape() for key in tensors.keys() if not key.startswith(RESIDUAL)]  # noqa: SIM118
    return sum(math.prod(shape) for shape in shapes)


def read_prior(name: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Configuration and weights of a prior, floats in float32 whatever the file holds.

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
