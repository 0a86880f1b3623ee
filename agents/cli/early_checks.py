"""Checks of a command's values that need no torch: names, paths and numbers, refused within a second.

A key has the same meaning in every command, so most checks look only at the key. Checks that belong to one command are
in the ``__post_init__`` of its config. Where the defaults would fail such a check, it is in a function ``check`` of the
command's module instead.
"""

from __future__ import annotations

import dataclasses
import math
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from agents.configuration.compose import group_options
from agents.configuration.prior_names import find_prior, split_name
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.files import exists, is_file
from scene_envs.plugins import plugin_entry_points
from scene_envs.scene_sources import find_scenes

COMPOSITES = ("clip", "gate", "product", "weighted_sum")
"""Rewards that need settings, so the group ``reward`` has no options with their names."""
_LEAST = {
    "count": 1,
    "num_steps": 1,
    "slots": 1,
    "batch_size": 1,
    "shard_size": 1,
    "fill": 0,
    "first": 0,
    "pictures": 0,
    "eta": 0,
    "friction": 0,
}
"""The least that a number may be, where a config's ``LEAST`` does not say otherwise."""
_POSITIVE = ("reward_timeout", "reward_memory")
_DEVICES = ("cpu", "cuda", "mps", "xpu", "hpu", "mtia", "xla", "ipu", "hip", "ve", "vulkan", "maia", "lazy", "meta")
_OTHER_DEVICES = ("privateuseone", "npu", "mlu", "musa", "mkldnn", "opengl", "opencl", "ideep", "fpga")
_DATASETS = ("data", "heldout", "regularisation.scenes")
_GRAMMAR = "grammar"


def check_early(settings: Any, config_dir: str = "", module: ModuleType | None = None) -> None:
    """Refuse unknown names, wrong paths and numbers out of range.

    Args:
        settings: the config of a command.
        config_dir: a folder with further options of groups.
        module: of the command, whose ``check(settings)`` is called where it has one.

    Raises:
        InvalidInputError: a number is outside its range, or nothing is at a path.
        UnknownNameError: no such prior, reward, scene type or mask; the nearest known one is offered.
    """
    _check_numbers(settings)
    if (own := getattr(module, "check", None)) is not None:
        own(settings)
    if (prior := getattr(settings, "prior", None)) and isinstance(prior, str):
        _check_prior(prior)
    for key in ("reward", "objective"):
        _check_name("reward", getattr(settings, key, None), known_rewards, "rewards.registry", config_dir)
    if (scene := getattr(settings, "scene", None)) is not None and not isinstance(scene, str):
        raise InvalidInputError(f"scene={str(scene)[:200]}: give the name of one scene type, or several joined by +")
    for scene in str(getattr(settings, "scene", "") or "").split("+"):
        _check_name("scene type", scene, known_scenes, "scene_envs.grammars", config_dir)
    for mask in [getattr(settings, "mask", None), *(getattr(settings, "masks", None) or [])]:
        _check_name("mask", mask, known_masks, "scene_envs.envs.masks", config_dir)
    if isinstance(device := getattr(settings, "device", "cpu"), str):
        _check_device(device)
    if (scenes := getattr(settings, "scenes", None)) and isinstance(scenes, str):
        find_scenes(Path(scenes))
    resumed = exists(Path(str(getattr(settings, "output", "") or "."), "checkpoint.pt"))
    kept = {"regularisation.scenes"} if resumed else set()  # a resumed run has them in its folder
    for key in set(_DATASETS) - kept - set(getattr(settings, "NO_PATHS", ())):
        _check_dataset(key, _dotted(settings, key))
    _check_guidance(settings)


def known_rewards(config_dir: str = "") -> list[str]:
    """Names of rewards that a command may be given; as :func:`rewards.list_rewards`, without torch."""
    return sorted({*group_options("reward", config_dir), *COMPOSITES, *plugin_entry_points("scene_envs.rewards")})


def known_scenes(config_dir: str = "") -> list[str]:
    """Names of scene types; none where installed packages may register more, as only their modules know the names."""
    groups = ("scene_envs.scene_types", "scene_envs.grammars")
    return [] if any(map(plugin_entry_points, groups)) else sorted(group_options("scene", config_dir))


def known_masks(config_dir: str = "") -> list[str]:
    """Names of mask generators; as :func:`scene_envs.list_masks`, without torch."""
    return sorted({*group_options("mask", config_dir), *plugin_entry_points("scene_envs.masks")})


def check_files(*paths: str) -> None:
    """Refuse paths at which there is no file."""
    for path in paths:
        if not is_file(Path(path)):
            raise InvalidInputError(f"{path[:200]!r} is no file; name one that is there")


def _check_numbers(settings: Any) -> None:
    workers = getattr(settings, "workers", 0)
    if isinstance(workers, int) and workers < 0:
        raise InvalidInputError(f"workers={workers}: give a number of processes, 0 for none")
    for key, least in {**_LEAST, **getattr(settings, "LEAST", {})}.items():
        value = getattr(settings, key, None)
        if isinstance(value, int | float) and not least <= value < math.inf:
            may_be_none = any(field.name == key and field.default is None for field in dataclasses.fields(settings))
            null = ", or null" if may_be_none else ""
            raise InvalidInputError(f"{key}={value} must be at least {least}{null}")
    for key in _POSITIVE:
        if isinstance(value := getattr(settings, key, None), int | float) and not value > 0:
            raise InvalidInputError(f"{key}={value} must be more than 0")


def _check_prior(name: str) -> None:
    own, adapters = split_name(name)
    find_prior(own)
    if not adapters or exists(Path(adapters)):
        return
    for part in adapters.split("+"):
        find_prior(part.rpartition("*")[2].strip())


def _check_name(kind: str, value: Any, known: Any, registry: str, config_dir: str) -> None:
    """Refuse a name that no option and no package has, unless this process may have registered more."""
    if registry in sys.modules:
        return
    name = value.get("name") if isinstance(value, dict) else value
    if isinstance(name, str) and name.isidentifier() and (names := known(config_dir)) and name not in names:
        raise unknown_name(kind, name, names)


def _check_device(device: str) -> None:
    found = re.fullmatch(r"([a-z]+)(:\d{1,4})?", device)
    if not found or found[1] not in (*_DEVICES, *_OTHER_DEVICES):
        raise InvalidInputError(f"device={device[:60]!r} is no torch device; give cpu, cuda or cuda:1")


def _check_dataset(key: str, value: Any) -> None:
    if not isinstance(value, str):
        return
    parts = [part.strip() for part in value.split(",")]
    if value and not any(parts):
        raise InvalidInputError(f"{key}={value[:200]!r} names no dataset; scene-envs generate makes one")
    for part in filter(None, parts):
        if part != _GRAMMAR and not exists(Path(part)):
            raise InvalidInputError(
                f"{key}={value[:200]!r}: nothing is at {part[:200]!r}; name a dataset, as scene-envs generate makes one"
            )


def _check_guidance(settings: Any) -> None:
    prompt, guidance = getattr(settings, "prompt", None), getattr(settings, "guidance", 0.0)
    if not math.isfinite(guidance):
        raise InvalidInputError(f"guidance={guidance} must be a finite number; 0 follows the prompt as it is")
    if hasattr(settings, "prompt") and (guidance or prompt is not None):
        from agents.post_training.config import check_prompt

        check_prompt(prompt, guidance)
    if strength := getattr(settings, "claim_guidance", 0.0):
        from scene_envs.envs.settings import check_claim_guidance

        check_claim_guidance(prompt if hasattr(settings, "prompt") else "those of real scenes", strength)
    if strength := getattr(settings, "physics_guidance", 0.0):
        from scene_envs.envs.settings import check_physics_guidance

        check_physics_guidance(strength)


def _dotted(settings: Any, key: str) -> Any:
    for part in key.split("."):
        settings = getattr(settings, part, None)
    return settings
