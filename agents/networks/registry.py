"""All networks by name: their sizes, how they are built, how a size is written to a file, and equal parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any, TypeVar

import torch
from torch import nn

from agents.networks.diffuscene import DiffuScene, DiffuSceneConfig, MixedDiffuScene, MixedDiffuSceneConfig
from agents.networks.flux import FluxConfig, FluxDenoiser
from agents.networks.midiffusion import MiDiffusion, MiDiffusionConfig, MixedMiDiffusion, MixedMiDiffusionConfig
from agents.networks.mixed_flux import MixedFlux
from agents.networks.mixed_flux_config import RENAMED, MixedFluxConfig
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import plugin_entry_points

NETWORKS = ("flux", "midiffusion", "diffuscene")
"""Ours, and the two that it is compared with."""
NETWORK_PROCESSES = ("continuous", "mixed")
"""What a network may denoise: scenes as numbers, or poses with discrete categories."""

ContinuousNetworkConfig = FluxConfig | MiDiffusionConfig | DiffuSceneConfig
MixedNetworkConfig = MixedFluxConfig | MixedMiDiffusionConfig | MixedDiffuSceneConfig
NetworkConfig = ContinuousNetworkConfig | MixedNetworkConfig


@dataclass(frozen=True)
class _Entry:
    """What the registry knows of a network: its classes, and the width besides ``hidden`` that equal counts adjust."""

    config: type[Any]
    network: Callable[[Any], nn.Module]
    ratio: str


_ENTRIES = {
    ("flux", "continuous"): _Entry(FluxConfig, FluxDenoiser, "mlp_ratio"),
    ("flux", "mixed"): _Entry(MixedFluxConfig, MixedFlux, "mlp_ratio"),
    ("midiffusion", "continuous"): _Entry(MiDiffusionConfig, MiDiffusion, "mlp_ratio"),
    ("midiffusion", "mixed"): _Entry(MixedMiDiffusionConfig, MixedMiDiffusion, "mlp_ratio"),
    ("diffuscene", "continuous"): _Entry(DiffuSceneConfig, DiffuScene, "inner_ratio"),
    ("diffuscene", "mixed"): _Entry(MixedDiffuSceneConfig, MixedDiffuScene, "inner_ratio"),
}
_NAMES = {entry.config: name for (name, _), entry in _ENTRIES.items()}
_BUILDERS = {entry.config: entry.network for entry in _ENTRIES.values()}
_RATIO_STEPS, _RATIO_STEP = 24, 1 / 64

ENTRY_POINT_GROUP = "scene_envs.networks"
"""Packages offer networks under this group: the entry's name is the network's, its value a class or a module that
:func:`register_network` decorates."""
Network = TypeVar("Network", bound=type[nn.Module])


def register_network(
    name: str, process: str, config: type[Any], ratio: str = "mlp_ratio"
) -> Callable[[Network], Network]:
    """Make a network available as ``network=name``; the same name again replaces it.

    The decorated class is made of a ``config``, and does what the networks here do: ``FluxDenoiser`` for scenes as
    numbers, ``MixedFlux`` for poses with categories.

    Args:
        name: letters, digits and underscores.
        process: ``"continuous"`` or ``"mixed"``.
        config: the dataclass of its size; those of its fields that :func:`network_config` knows are filled in.
        ratio: field of ``config`` that equal parameter counts adjust beside ``hidden``.

    Raises:
        InvalidInputError: the name is not one word.
        UnknownNameError: no process has that name.
    """
    if not name.isidentifier():
        raise InvalidInputError(f"network name {name!r}: use letters, digits and underscores, such as 'my_flux'")
    if process not in NETWORK_PROCESSES:
        raise unknown_name("process", process, NETWORK_PROCESSES)

    def register(network: Network) -> Network:
        _ENTRIES[name, process] = _Entry(config, network, ratio)
        _NAMES[config], _BUILDERS[config] = name, network
        return network

    return register


def list_networks() -> list[str]:
    """Names of all networks, those of installed packages included, sorted."""
    return sorted({name for name, _ in _ENTRIES} | set(plugin_entry_points(ENTRY_POINT_GROUP)))


def build_network(config: NetworkConfig) -> nn.Module:
    """A network with fresh weights.

    Raises:
        InvalidInputError: ``config`` is not the configuration of a network.

    >>> type(build_network(MiDiffusionConfig(features=20, hidden=32, depth=1))).__name__
    'MiDiffusion'
    """
    if type(config) not in _BUILDERS:
        known = ", ".join(kind.__name__ for kind in _BUILDERS)
        raise InvalidInputError(f"{type(config).__name__} is not the configuration of a network; these are: {known}")
    return _BUILDERS[type(config)](config)


def network_config(
    name: str,
    process: str,
    *,
    features: int,
    categories: int,
    hidden: int,
    depth: int,
    heads: int,
    text_width: int = 0,
    attention: str = "plain",
    relation_blur: str = "axis",
    frequencies: int = 8,
    unit: tuple[float, float, float] = (1.0, 1.0, 1.0),
    text_reach: str = "all",
    pooled_text: int = 0,
    count_embedding: int = 0,
    count_conditioning: int = 0,
    kinds: tuple[int, ...] = (),
    rotation_features: int = 0,
    contacts: int = 0,
    rotations: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,) * 9, (0.0,) * 9),
) -> NetworkConfig:
    """The size of a network from the keys that all networks share.

    Args:
        name: one of :data:`NETWORKS`.
        process: ``"continuous"`` or ``"mixed"``.
        features: D, numbers per slot; read by continuous networks.
        categories: K = C + 1; read by mixed networks.
        hidden: width; of ``diffuscene`` its channels, which make about twice as many parameters.
        depth: blocks. Mixed ``flux`` has a third as many double-stream blocks besides when there is text, and
            ``diffuscene`` has a third as many residual blocks per level.
        heads: attention heads.
        text_width: width of the text tokens; 0 for none. The continuous ``flux`` reads none.
        attention, relation_blur: read by the mixed ``flux`` alone, see :class:`~agents.networks.MixedFluxConfig`.
        frequencies: read by ``flux`` alone: the others are as published, unless their configuration is made by hand.
        unit: read by the mixed ``flux`` alone.
        text_reach, pooled_text, count_embedding, count_conditioning, kinds: read by the mixed ``flux`` alone.
        rotation_features, contacts, rotations: read by the mixed ``flux`` alone.

    Raises:
        UnknownNameError: no network or no process has that name.
        InvalidInputError: sizes do not fit each other, or text is asked of a network that reads none.

    >>> network_config("midiffusion", "mixed", features=20, categories=8, hidden=64, depth=4, heads=4).hidden
    64
    """
    given = dict(locals())
    entry = _entry(name, process)
    sizes: dict[str, Any] = {"hidden": hidden, "heads": heads}
    sizes |= {"features": features} if process == "continuous" else {"categories": categories}
    if name not in NETWORKS:
        sizes = {field.name: given[field.name] for field in fields(entry.config) if field.name in given}
    elif name == "diffuscene":
        sizes |= {"blocks": max(1, depth // 3), "text_width": text_width}
    elif name == "midiffusion":
        sizes |= {"depth": depth, "text_width": text_width}
    elif process == "continuous":
        if text_width:
            raise InvalidInputError(f"text_width={text_width}: the continuous flux network reads no text; use 0")
        sizes |= {"depth": depth, "frequencies": frequencies}
    else:
        sizes |= {"double_blocks": max(1, depth // 3), "single_blocks": depth, "embedding": hidden}
        sizes |= {"text_width": text_width, "frequencies": frequencies, "unit": unit}
        sizes |= {"attention": attention, "relation_blur": relation_blur}
        sizes |= {"text_reach": text_reach, "pooled_text": pooled_text, "count_embedding": count_embedding}
        sizes |= {"count_conditioning": count_conditioning if text_width else 0, "kinds": kinds}
        sizes |= {"rotation_features": rotation_features, "contacts": contacts, "rotations": rotations}
    config: NetworkConfig = entry.config(**sizes)
    return config


def config_state(config: NetworkConfig) -> dict[str, Any]:
    """The fields of a configuration and its ``kind``, for a file.

    >>> config_state(FluxConfig(features=20))["kind"]
    'flux'
    """
    if type(config) not in _NAMES:
        raise InvalidInputError(f"{type(config).__name__} is not the configuration of a network")
    return {"kind": _NAMES[type(config)], **asdict(config)}


def config_from_state(state: Mapping[str, Any], process: str) -> NetworkConfig:
    """Inverse of :func:`config_state`; files without a ``kind`` hold ``flux`` networks.

    Raises:
        UnknownNameError: no network or no process has that name.
        InvalidInputError: fields are missing or not known; names them.
    """
    name = state.get("kind", "flux")
    kind = _entry(name, process).config
    values = {RENAMED.get(key, key): value for key, value in state.items() if key != "kind"}
    strange = sorted(values.keys() - {field.name for field in fields(kind)})
    missing = sorted(
        field.name
        for field in fields(kind)
        if field.name not in values and field.default is MISSING and field.default_factory is MISSING
    )
    if strange or missing:
        raise InvalidInputError(
            f"the configuration of a {process} {name} network has unknown fields {strange} and lacks {missing}"
        )
    config: NetworkConfig = kind(**values)
    return config


@lru_cache(maxsize=1024)
def parameter_count(config: NetworkConfig) -> int:
    """Parameters of a network; leaves the random state alone.

    >>> parameter_count(FluxConfig(features=20, hidden=96, depth=3, heads=4))
    466916
    """
    with torch.random.fork_rng(devices=[]):
        return sum(parameter.numel() for parameter in build_network(config).parameters())


def match_parameters(name: str, process: str, target: int, **sizes: Any) -> NetworkConfig:
    """The size at which a network has nearly ``target`` parameters, for comparisons at equal parameters.

    The width ``hidden`` is chosen first. As it goes in multiples of ``heads``, the width inside the blocks (the MLPs of
    the transformers, the residual blocks of ``diffuscene``) then makes up for the rest: the least change, of at most
    3/8, that comes within 1 %, or else what comes nearest.

    Args:
        name: one of :data:`NETWORKS`.
        process: ``"continuous"`` or ``"mixed"``.
        target: parameters, as :func:`parameter_count` counts them.
        sizes: the keys of :func:`network_config` but for ``hidden``.

    Raises:
        InvalidInputError: the narrowest such network has more parameters than ``target``.

    >>> ours = network_config("flux", "mixed", features=20, categories=8, hidden=96, depth=4, heads=4)
    >>> keys = {"features": 20, "categories": 8, "depth": 4, "heads": 4}
    >>> theirs = match_parameters("diffuscene", "mixed", parameter_count(ours), **keys)
    >>> abs(parameter_count(theirs) / parameter_count(ours) - 1) < 0.03
    True
    """
    entry = _entry(name, process)

    def at_width(units: int) -> NetworkConfig:
        return network_config(name, process, hidden=units * sizes["heads"], **sizes)

    def at_ratio(config: NetworkConfig, step: int) -> NetworkConfig:
        ratio = getattr(config, entry.ratio) * (1 + step * _RATIO_STEP)
        changed: NetworkConfig = replace(config, **{entry.ratio: ratio})
        return changed

    smallest = parameter_count(at_width(1))
    if target < smallest:
        raise InvalidInputError(
            f"target={target}: a {process} {name} network of this depth and these heads has at least {smallest} "
            "parameters; ask for more, or lower depth"
        )
    highest = 1
    while parameter_count(at_width(highest)) < target:
        highest *= 2
    width = _last(1, highest, lambda units: parameter_count(at_width(units)) <= target)
    candidates: list[tuple[NetworkConfig, int]] = []
    for units in (width, width + 1):
        step = _last(
            -_RATIO_STEPS,
            _RATIO_STEPS - 1,
            lambda step, units=units: parameter_count(at_ratio(at_width(units), step)) <= target,  # type: ignore[misc]
        )
        candidates += [(at_ratio(at_width(units), near), abs(near)) for near in (step, step + 1, 0)]

    def distance(candidate: tuple[NetworkConfig, int]) -> tuple[float, int]:
        """How far the count is off, of which less than a hundredth counts less than how far the ratio is."""
        config, departure = candidate
        return max(abs(parameter_count(config) / target - 1.0), 0.01), departure

    return min(candidates, key=distance)[0]


def _entry(name: str, process: str) -> _Entry:
    if process not in NETWORK_PROCESSES:
        raise unknown_name("process", process, NETWORK_PROCESSES)
    points = plugin_entry_points(ENTRY_POINT_GROUP)
    if (name, process) not in _ENTRIES and name in points:
        points[name].load()
    if (name, process) not in _ENTRIES:
        if name in list_networks():
            raise InvalidInputError(f"network {name!r} has no {process} form; choose another process")
        raise unknown_name("network", name, list_networks())
    return _ENTRIES[name, process]


def _last(low: int, high: int, holds: Callable[[int], bool]) -> int:
    """The largest number from ``low`` to ``high`` for which ``holds``, which must not hold again once it does not.

    ``low`` when it holds for none.
    """
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if holds(middle) else (low, middle - 1)
    return low
