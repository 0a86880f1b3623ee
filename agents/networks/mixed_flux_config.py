"""Configuration of the Flux-style transformer of mixed scenes: the size of its core, and its modules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

from agents.networks.contacts import ContactsConfig
from agents.networks.count_conditioning import CountConditioningConfig
from agents.networks.count_embedding import CountEmbeddingConfig
from agents.networks.flux_modules import ModuleConfig
from agents.networks.fourier_features import FourierFeaturesConfig
from agents.networks.observed_flags import ObservedFlagsConfig
from agents.networks.pooled_text import PooledTextConfig
from agents.networks.relations import RelationsConfig
from agents.networks.rotation_features import RotationFeaturesConfig
from scene_envs.errors import InvalidInputError, unknown_name

TEXT_REACHES = ("all", "double")
"""Blocks in which slots and text attend to each other."""
TIME_INPUTS = ("timestep", "log_noise")
"""Numbers that may be embedded as time: t - 1, or 250 times the logarithm of the noise-to-signal ratio."""
MODULES: dict[str, type[ModuleConfig]] = {
    kind.name: kind
    for kind in (
        ObservedFlagsConfig,
        PooledTextConfig,
        CountEmbeddingConfig,
        CountConditioningConfig,
        RelationsConfig,
        FourierFeaturesConfig,
        RotationFeaturesConfig,
        ContactsConfig,
    )
}
"""The configurations of all modules by name; a new module is one more entry."""


@dataclass(frozen=True)
class MixedFluxSize:
    """Size of the core of a :class:`~agents.networks.MixedFlux`; :class:`MixedFluxConfig` describes the fields."""

    categories: int
    hidden: int = 128
    double_blocks: int = 2
    single_blocks: int = 4
    heads: int = 4
    mlp_ratio: float = 4.0
    embedding: int = 128
    pose_head: int = 64


@dataclass(frozen=True)
class MixedFluxConfig(MixedFluxSize):
    """Size of a :class:`~agents.networks.MixedFlux`, what it reads, and the modules that are added to its core.

    Attributes:
        categories: K = C + 1, assets and *empty*; the mask token is one more.
        hidden: H, width of the token streams; a multiple of ``heads``.
        double_blocks: blocks in which text and slots have weights of their own; used only with text.
        single_blocks: blocks on text and slots together.
        heads: attention heads.
        mlp_ratio: width of the MLPs over ``hidden``.
        embedding: E, width of the embedding of a slot, and of what leaves the last layer.
        pose_head: hidden width of the pose output.
        text_width: W, width of the text tokens; 0 for none.
        text_reach: how far text goes: to the ``"double"``-stream blocks, or through ``"all"`` blocks, as the paper's.
        time_input: what is embedded as time, one of :data:`TIME_INPUTS`; ``"timestep"`` is the paper's.
        time_scale: what the time is multiplied by before it is embedded.
        unit: metres per normalised unit along x, y, z, for modules that read geometry.
        rotations: what the nine normalised numbers of a rotation are multiplied by, and what is then added, to be that
            of an object, for modules that read rotations.
        modules: what is added to the core, in the order in which it is applied; the paper has none. Mappings
            ``{"name": …, **fields}`` become configurations.

    >>> config = MixedFluxConfig(8, modules=(RelationsConfig(blur="axis"), ContactsConfig()))
    >>> config.without("contacts").modules
    (RelationsConfig(blur='axis'),)
    """

    text_width: int = 0
    text_reach: str = "all"
    time_input: str = "timestep"
    time_scale: float = 1.0
    unit: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rotations: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,) * 9, (0.0,) * 9)
    modules: tuple[ModuleConfig, ...] = ()

    reads_slot_mask: ClassVar[bool] = True
    """Whether the network can be told to ignore slots."""

    def __post_init__(self) -> None:
        if self.text_reach not in TEXT_REACHES:
            raise unknown_name("reach of text", self.text_reach, TEXT_REACHES)
        if self.time_input not in TIME_INPUTS:
            raise unknown_name("time input", self.time_input, TIME_INPUTS)
        object.__setattr__(self, "unit", tuple(self.unit))  # lists, when they come from JSON
        object.__setattr__(self, "rotations", tuple(tuple(numbers) for numbers in self.rotations))
        object.__setattr__(self, "modules", tuple(make_module(entry) for entry in self.modules))
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")
        before: list[str] = []
        for module in self.modules:
            lacking = [name for name in module.requires if name not in before]
            if lacking:
                raise InvalidInputError(f"the module {module.name!r} needs {', '.join(lacking)} before it in modules")
            if module.reads_text and not self.text_width:
                raise InvalidInputError(f"the module {module.name!r} needs a network with text, text_width above 0")
            if module.name in before:
                raise InvalidInputError(f"the module {module.name!r} is listed twice")
            before.append(module.name)

    @property
    def blocks(self) -> int:
        """Attention blocks, double-stream and single-stream."""
        return (self.double_blocks if self.text_width else 0) + self.single_blocks

    @property
    def pair_width(self) -> int:
        """Features of a pair of slots, of all modules."""
        return sum(module.pair_width for module in self.modules)

    def without(self, *names: str) -> MixedFluxConfig:
        """The same network without some modules, which is an ablation.

        Raises:
            UnknownNameError: the network has no such module.
        """
        present = [module.name for module in self.modules]
        for name in names:
            if name not in present:
                raise unknown_name("module of the network", name, present)
        return replace(self, modules=tuple(module for module in self.modules if module.name not in names))


def module_states(config: MixedFluxConfig) -> list[dict[str, Any]]:
    """The modules for a file: their names and fields."""
    return [{"name": module.name, **vars(module)} for module in config.modules]


def make_module(entry: ModuleConfig | Mapping[str, Any]) -> ModuleConfig:
    """A module's configuration: ``entry`` itself, or made from ``{"name": …, **fields}``."""
    if isinstance(entry, ModuleConfig):
        return entry
    options = {key: value for key, value in entry.items() if key != "name"}
    name = entry.get("name", "")
    if name not in MODULES:
        raise unknown_name("module of the network", str(name), MODULES)
    strange = sorted(options.keys() - {field.name for field in fields(MODULES[name])})
    if strange:
        raise InvalidInputError(f"the module {name!r} has no fields {strange}")
    return MODULES[name](**options)
