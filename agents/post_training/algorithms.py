"""Registry of post-training algorithms: their settings and the location of their code; imports no torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, TypeVar

from agents.post_training.algorithm_settings import (
    AlgorithmSettings,
    AWMSettings,
    DDPOISSettings,
    DDPOSFSettings,
    GuidanceDistillationSettings,
    NFTSettings,
)
from scene_envs.registry import Registry

ENTRY_POINT_GROUP = "scene_envs.algorithms"
"""Entry points of installed packages: modules that call :func:`register_algorithm` when they are imported."""

Algorithm = TypeVar("Algorithm", bound=type)


@dataclass(frozen=True)
class _Entry:
    settings: type[AlgorithmSettings]
    code: Any
    """The class, or its ``module:class``, which is imported when it is needed."""


_FORWARD = "agents.post_training.forward_process:ForwardProcess"
_ALGORITHMS = Registry(
    "algorithm",
    ENTRY_POINT_GROUP,
    {
        "ddpo_sf": _Entry(DDPOSFSettings, "agents.post_training.ddpo:DDPO"),
        "ddpo_is": _Entry(DDPOISSettings, "agents.post_training.ddpo:DDPO"),
        "guidance_distillation": _Entry(
            GuidanceDistillationSettings, "agents.post_training.guidance_distillation:GuidanceDistillation"
        ),
        "nft": _Entry(NFTSettings, _FORWARD),
        "awm": _Entry(AWMSettings, _FORWARD),
    },
)


def register_algorithm(
    name: str, settings: type[AlgorithmSettings] = DDPOSFSettings
) -> Callable[[Algorithm], Algorithm]:
    """Make an algorithm available as ``algorithm=name``; the same name again replaces it.

    The decorated class takes ``(settings, policy, stds)`` and extends :class:`agents.post_training.base.Algorithm`
    or one of its subclasses, such as :class:`agents.post_training.DDPO`.

    Args:
        name: letters, digits and underscores.
        settings: the dataclass of its keys, with a sentence for each under ``Attributes:``.

    Raises:
        InvalidInputError: the name is not one word.
    """
    _ALGORITHMS.check_name(name, "my_ddpo")
    return _ALGORITHMS.adding(name, lambda algorithm: _Entry(settings, algorithm))


def list_algorithms() -> list[str]:
    """Names of all algorithms, those of installed packages included, sorted."""
    return _ALGORITHMS.names()


def algorithm_settings(name: str) -> type[AlgorithmSettings]:
    """The dataclass of an algorithm's keys.

    Raises:
        UnknownNameError: no algorithm has that name; the nearest known one is offered.
    """
    return _ALGORITHMS[name].settings


def make_algorithm(settings: AlgorithmSettings, policy: Any, stds: Any) -> Any:
    """The algorithm of these settings for a policy, whose steps have the standard deviations ``stds`` (S,)."""
    code = _ALGORITHMS[settings.name].code
    if isinstance(code, str):
        module, _, attribute = code.partition(":")
        code = getattr(import_module(module), attribute)
    return code(settings, policy, stds)
