"""Parameter counts of networks, and sizes at which two networks have equally many parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import torch

from agents.networks.registry import NetworkConfig, build_network, network_config, ratio_name
from scene_envs.errors import InvalidInputError

_RATIO_STEPS, _RATIO_STEP = 24, 1 / 64


@lru_cache(maxsize=1024)
def parameter_count(config: NetworkConfig) -> int:
    """Number of parameters of a network; leaves the random state unchanged.

    >>> from agents.networks.flux import FluxConfig
    >>> parameter_count(FluxConfig(features=20, hidden=96, depth=3, heads=4))
    466916
    """
    with torch.random.fork_rng(devices=[]):
        return sum(parameter.numel() for parameter in build_network(config).parameters())


def match_parameters(name: str, process: str, target: int, **sizes: Any) -> NetworkConfig:
    """The size at which a network has nearly ``target`` parameters, for comparisons at equal parameters.

    The width ``hidden`` is chosen first, as a multiple of ``heads``. Then the width inside the blocks (the MLPs of the
    transformers, the residual blocks of ``diffuscene``) is changed by at most 3/8. The least change that brings the
    count within 1 % of ``target`` is taken, or else the change that brings it nearest.

    Args:
        name: of a network.
        process: ``"continuous"`` or ``"mixed"``.
        target: parameters, as :func:`parameter_count` counts them.
        sizes: the keys of :func:`network_config` except ``hidden``.

    Raises:
        InvalidInputError: the narrowest such network has more parameters than ``target``.

    >>> ours = network_config("flux", "mixed", features=20, categories=8, hidden=96, depth=4, heads=4)
    >>> keys = {"features": 20, "categories": 8, "depth": 4, "heads": 4}
    >>> theirs = match_parameters("diffuscene", "mixed", parameter_count(ours), **keys)
    >>> abs(parameter_count(theirs) / parameter_count(ours) - 1) < 0.03
    True
    """
    ratio_field = ratio_name(name, process)

    def at_width(units: int) -> NetworkConfig:
        return network_config(name, process, hidden=units * sizes["heads"], **sizes)

    def at_ratio(config: NetworkConfig, step: int) -> NetworkConfig:
        if ratio_field is None:
            return config
        ratio = getattr(config, ratio_field) * (1 + step * _RATIO_STEP)
        return replace(config, **{ratio_field: ratio})

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
        """Sort key: relative error of the count, where errors below 1 % count as 1 %, then change of the ratio."""
        config, departure = candidate
        return max(abs(parameter_count(config) / target - 1.0), 0.01), departure

    return min(candidates, key=distance)[0]


def _last(low: int, high: int, holds: Callable[[int], bool]) -> int:
    """The largest number from ``low`` to ``high`` for which ``holds`` is true; ``low`` when it is true for none.

    Once ``holds`` is false for a number, it must be false for all larger ones.
    """
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if holds(middle) else (low, middle - 1)
    return low
