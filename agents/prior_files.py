"""Where priors live on disk: names, directories, safetensors and their configuration."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name

SHIPPED = Path(__file__).parent / "priors"
CONFIG_NAME = "config.json"
WEIGHTS_NAME = "model.safetensors"


def list_priors() -> list[str]:
    """Names of the priors that ship with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONFIG_NAME}"))


def find_prior(name: str | os.PathLike[str]) -> Path:
    """The directory of a prior: a shipped name, a prior directory, or a run directory that holds ``prior/``."""
    path = Path(name)
    for candidate in (SHIPPED / str(name), path, path / "prior"):
        if (candidate / CONFIG_NAME).is_file():
            return candidate
    if path.exists() or os.sep in str(name):
        raise InvalidInputError(f"{str(name)!r} holds no prior: neither it nor its prior/ folder has a {CONFIG_NAME}")
    raise unknown_name("prior", str(name), list_priors())


def write_prior(directory: str | os.PathLike[str], config: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> Path:
    """Write a prior's configuration and weights, each file atomically."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    weights = directory / (WEIGHTS_NAME + ".partial")
    save_file({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, weights)
    weights.chmod(0o644)
    os.replace(weights, directory / WEIGHTS_NAME)
    partial = directory / (CONFIG_NAME + ".partial")
    partial.write_text(json.dumps(config, indent=1) + "\n")
    os.replace(partial, directory / CONFIG_NAME)
    return directory


def read_prior(name: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Configuration and weights of a prior.

    Raises:
        UnknownNameError: no shipped prior has that name (the nearest one is offered).
        CorruptFileError: a file is truncated or not what its name says.
    """
    directory = find_prior(name)
    try:
        config = json.loads((directory / CONFIG_NAME).read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{str(directory / CONFIG_NAME)!r} is not valid JSON: {error}") from error
    weights = directory / WEIGHTS_NAME
    try:
        return config, load_file(weights)
    except FileNotFoundError:
        raise CorruptFileError(f"the prior at {str(directory)!r} lacks its weights, {WEIGHTS_NAME}") from None
    except SafetensorError as error:
        raise CorruptFileError(
            f"{str(weights)!r} is truncated or not a safetensors file ({error}); copy it again or train anew"
        ) from error
