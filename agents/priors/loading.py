"""Loading and saving of priors, whose classes are known by the name of their process."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, cast

from torch import Tensor

from agents.configuration.prior_names import joint_name, split_name
from agents.diffusion import Preconditioning, ResidualVariance
from agents.networks.registry import config_state
from agents.priors.adapters import AdapterSpec, merge_adapters, parse_adapters
from agents.priors.storage import StoredPrior, explained, read_stored, write_stored
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType

Prior = TypeVar("Prior", bound="Loadable")

_CLASSES: dict[str, type[Loadable]] = {}
"""Classes of priors by the name of their process."""


class Loadable(ABC):
    """The part of a prior that loads and saves its files."""

    process_name = ""
    """Name of the process in configuration files; a subclass that sets it can be loaded by :meth:`load`."""
    config: Any
    """Configuration of the prior, a dataclass."""
    denoiser: Any
    """The network inside its process, a module with ``.network``."""
    scene_type: SceneType
    normalizer: Normalizer
    preconditioning: Preconditioning
    card: dict[str, Any]
    loaded_as: str = ""
    """Name or path by which :meth:`load` found the prior, with its adapters; empty for one that was not loaded."""
    residual: ResidualVariance | None

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if cls.process_name:
            _CLASSES[cls.process_name] = cls

    def config_state(self) -> dict[str, Any]:
        """The ``prior`` entry of the configuration file."""
        return {**asdict(self.config), "network": config_state(self.config.network)}

    @classmethod
    @abstractmethod
    def from_state(
        cls: type[Prior],
        fields: dict[str, Any],
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None,
        residual: ResidualVariance | None,
    ) -> Prior:
        """From the ``prior`` entry of a configuration file."""

    @classmethod
    def load(cls: type[Prior], name: str | os.PathLike[str] | Loadable, adapter: AdapterSpec | None = None) -> Prior:
        """A shipped prior by name, or one from a prior or run directory; in evaluation mode.

        Args:
            name: of the prior; ``NAME with ADAPTER`` names its adapters as well.
            adapter: updates that are added to its weights: priors that were trained from this one, or the folders of
                such runs. Several are joined by ``+`` or in a list, each with a factor before ``*`` if need be.

        Raises:
            UnknownNameError: no shipped prior has that name.
            InvalidInputError: an adapter is missing, or was trained on another prior.
            CorruptFileError: its files are not those of a prior, or do not fit each other.
        """
        if isinstance(name, Loadable):
            if adapter:
                raise InvalidInputError(
                    f"adapter={adapter!r} is added to a prior that is loaded by name; give its name or folder, not the "
                    "prior itself"
                )
            return cast(Prior, name)
        name, named = split_name(name)
        terms = [term for spec in (named, adapter) if spec for term in parse_adapters(spec)]
        stored = read_stored(name)
        with explained(name):
            prior = prior_class(stored.process).from_state(
                stored.fields, stored.normalizer, stored.preconditioning, stored.card, stored.residual
            )
            prior.load_weights(stored.tensors)
        if terms:
            merge_adapters(prior, str(name), terms)
        prior.loaded_as = joint_name(name, [spec for spec in (named, adapter) if spec])
        return cast(Prior, prior.eval())

    def save(self, directory: str | os.PathLike[str], precision: str = "float32") -> Path:
        """Write ``config.json`` and ``model.safetensors`` into ``directory``.

        Args:
            directory: folder, made if need be.
            precision: of the weights in the file, ``"float32"`` or ``"float16"``; loaded weights are float32 again.
        """
        stored = StoredPrior(
            self.process_name,
            self.config_state(),
            self.scene_type,
            self.normalizer,
            self.preconditioning,
            self.card,
            self.residual,
            self.weights(),
        )
        return write_stored(directory, stored, precision)

    def weights(self) -> dict[str, Tensor]:
        """Trained tensors by name, as a prior's file holds them."""
        return dict(self.denoiser.network.state_dict())

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`; raises RuntimeError when names or shapes differ."""
        self.denoiser.network.load_state_dict(tensors)


def prior_class(process: str) -> type[Any]:
    """The class of priors of a process: ``"continuous"``, ``"mixed"``, or the ``process_name`` of another subclass."""
    if process not in _CLASSES:
        raise unknown_name("process", process, _CLASSES)
    return _CLASSES[process]
