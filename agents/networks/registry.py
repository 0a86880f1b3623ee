"""Registry of networks: their sizes, how they are built, and how a size is written to a file."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any

from torch import nn

from agents.configuration.composition import check_types
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.registry import load_plugins

NETWORK_PROCESSES = ("continuous", "mixed")
"""Processes that a network may denoise: scenes as numbers, or poses with discrete categories."""
ENTRY_POINT_GROUP = "scene_envs.networks"
"""Entry points of installed packages: modules that call :func:`register_network` when they are imported."""

NetworkConfig = Any
"""The configuration of a network: a frozen dataclass that was registered with it."""


@dataclass(frozen=True)
class _Entry:
    """The arguments of :func:`register_network`."""

    config: type[Any]
    network: Callable[[Any], nn.Module]
    sizes: Callable[[Mapping[str, Any]], dict[str, Any]]


_ENTRIES: dict[tuple[str, str], _Entry] = {}


def register_network(
    name: str, process: str, config: type[Any], network: Callable[[Any], nn.Module], *,
    sizes: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None,
) -> None:  # fmt: skip
    """Make a network known as ``network=NAME`` to training, files and comparisons.

    A mixed network has the ``forward`` of :class:`~agents.networks.MixedFlux`, a continuous one that of
    :class:`~agents.networks.FluxDenoiser`. A mixed one may say in its configuration what time it reads
    (``time_input``, see :class:`~agents.networks.MixedFluxConfig`; timesteps where it says nothing) and whether it
    takes ``slot_mask`` (``reads_slot_mask``). A package lists the module that calls this under the entry points
    ``scene_envs.networks``.

    Args:
        name: name of the network.
        process: ``"continuous"`` or ``"mixed"``.
        config: class of its configuration: a frozen dataclass of JSON values with ``categories`` (mixed) or
            ``features`` (continuous), and ``text_width`` where it reads text.
        network: function from such a configuration to a module, which keeps it as ``config``.
        sizes: function from the keys of :func:`network_config` to fields of ``config`` besides ``categories`` or
            ``features``; None takes the same keys.

    Raises:
        UnknownNameError: no process has that name.
        InvalidInputError: another network has the name, or ``config`` is not a dataclass.
    """
    if process not in NETWORK_PROCESSES:
        raise unknown_name("process", process, NETWORK_PROCESSES)
    if not is_dataclass(config):
        raise InvalidInputError(f"config={config!r} is not a dataclass; a network's configuration must be one")
    if (name, process) in _ENTRIES and _ENTRIES[name, process].config is not config:
        raise InvalidInputError(f"there is a {process} network {name!r} already; choose another name")
    known = {field.name for field in fields(config)}
    _ENTRIES[name, process] = _Entry(
        config, network, sizes or (lambda keys: {key: value for key, value in keys.items() if key in known})
    )


def list_networks(process: str) -> list[str]:
    """Names of all networks of a process, those of installed packages among them.

    >>> list_networks("mixed")[:3]
    ['flux', 'midiffusion', 'diffuscene']
    """
    load_plugins(ENTRY_POINT_GROUP)
    return [name for name, kind in _ENTRIES if kind == process]


def build_network(config: NetworkConfig) -> nn.Module:
    """A network with fresh weights; an InvalidInputError if ``config`` is not the configuration of a network.

    >>> from agents.networks import FluxConfig
    >>> type(build_network(FluxConfig(features=20, hidden=32, depth=1, heads=2))).__name__
    'FluxDenoiser'
    """
    return _entry_of(config).network(config)


def network_config(
    name: str, process: str, *, features: int, categories: int, hidden: int, depth: int, heads: int,
    text_width: int = 0, frequencies: int = 8, double_blocks: int | None = None, embedding: int | None = None,
    pose_head: int = 64, time_scale: float = 1.0, text_reach: str = "all",
    modules: Sequence[Any] | None = None,
    unit: tuple[float, float, float] = (1.0, 1.0, 1.0),
    rotations: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,) * 9, (0.0,) * 9),
) -> NetworkConfig:  # fmt: skip
    """The size of a network from the keys that all networks share; :class:`~agents.networks.MixedFluxConfig` describes
    those that the mixed ``flux`` alone reads.

    Args:
        name: name of a network, see :func:`list_networks`.
        process: ``"continuous"`` or ``"mixed"``.
        features: D, numbers per slot; read by continuous networks.
        categories: K = C + 1; read by mixed networks.
        hidden: width. For ``diffuscene`` it is the number of channels, and gives about twice as many parameters.
        depth: number of blocks. Mixed ``flux`` with text has a third as many double-stream blocks in addition.
            ``diffuscene`` has a third as many residual blocks per level.
        heads: attention heads.
        text_width: width of the text tokens, 0 for none; read by mixed networks.
        frequencies: octaves of Fourier features, read by ``flux`` alone.
        double_blocks: None for a third of ``depth``.
        embedding: None for ``hidden``.
        modules: in any order, without the Fourier features; None for the flags of inpainting alone.

    Raises:
        UnknownNameError: no network or no process has that name.
        InvalidInputError: sizes do not fit each other, or text is asked of a network that reads none.

    >>> network_config("midiffusion", "mixed", features=20, categories=8, hidden=64, depth=4, heads=4).hidden
    64
    """
    keys = {key: value for key, value in locals().items() if key not in ("name", "process")}
    entry = _entry(name, process)
    width = {"categories": categories} if process == "mixed" else {"features": features}
    return entry.config(**{**width, **entry.sizes(keys)})


def config_state(config: NetworkConfig) -> dict[str, Any]:
    """The fields of a configuration and its ``kind``, for a file.

    >>> from agents.networks import FluxConfig
    >>> config_state(FluxConfig(features=20))["kind"]
    'flux'
    """
    entry = _entry_of(config)
    (name,) = [name for (name, _), known in _ENTRIES.items() if known is entry]
    return {"kind": name, **(config.state() if hasattr(config, "state") else asdict(config))}


def config_from_state(state: Mapping[str, Any], process: str) -> NetworkConfig:
    """Inverse of :func:`config_state`. An UnknownNameError if no network or no process has that name, an
    InvalidInputError that names fields which are missing, not known, or of another type.
    """
    name = state.get("kind", "")
    kind = _entry(name, process).config
    values = {key: value for key, value in state.items() if key != "kind"}
    try:
        inspect.signature(kind).bind(**values)
    except TypeError as error:
        raise InvalidInputError(f"the configuration of a {process} {name} network: {error}") from error
    check_types(kind, values)
    return kind(**values)


def _entry(name: str, process: str) -> _Entry:
    if process not in NETWORK_PROCESSES:
        raise unknown_name("process", process, NETWORK_PROCESSES)
    if (name, process) not in _ENTRIES:
        load_plugins(ENTRY_POINT_GROUP)
    if (name, process) not in _ENTRIES:
        raise unknown_name("network", name, list_networks(process))
    return _ENTRIES[name, process]


def _entry_of(config: Any) -> _Entry:
    found = [entry for entry in _ENTRIES.values() if entry.config is type(config)]
    if not found:
        known = ", ".join(entry.config.__name__ for entry in _ENTRIES.values())
        raise InvalidInputError(f"{type(config).__name__} is not the configuration of a network; these are: {known}")
    return found[0]
