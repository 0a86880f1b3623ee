"""Checks of a command's values that need no torch: names, paths and processes, refused within a second."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from agents.configuration.compose import group_options
from agents.utils.scene_sources import find_scenes
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.files import exists
from scene_envs.plugins import plugin_entry_points

COMPOSITES = ("clip", "gate", "normalised", "product", "weighted_sum")
"""Rewards that need settings, so that no option of the group ``reward`` is called like them."""


def check_early(settings: Any, config_dir: str = "") -> None:
    """Refuse names, paths and numbers of processes that cannot be.

    Args:
        settings: the config of a command.
        config_dir: a folder with further options of groups.

    Raises:
        InvalidInputError: a negative number of processes, or nothing at ``scenes=``.
        UnknownNameError: no such prior or reward; the nearest known one is offered.
    """
    workers = getattr(settings, "workers", 0)
    if isinstance(workers, int) and workers < 0:
        raise InvalidInputError(f"workers={workers}: give a number of processes, 0 for none")
    if (prior := getattr(settings, "prior", None)) and isinstance(prior, str):
        _check_prior(prior)
    for key in ("reward", "objective"):
        _check_reward(getattr(settings, key, None), config_dir)
    if (scenes := getattr(settings, "scenes", None)) and isinstance(scenes, str) and not prior:
        find_scenes(Path(scenes))


def shipped_priors() -> list[str]:
    """Names of the priors that ship with the package; as :func:`agents.priors.list_priors`, without torch."""
    spec = find_spec("agents.priors")
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    return sorted(path.parent.name for folder in folders for path in Path(folder, "shipped").glob("*/config.json"))


def known_rewards(config_dir: str = "") -> list[str]:
    """Names of rewards that a command may be given; as :func:`rewards.list_rewards`, without torch."""
    return sorted({*group_options("reward", config_dir), *COMPOSITES, *plugin_entry_points("scene_envs.rewards")})


def _check_prior(name: str) -> None:
    if name.isidentifier() and not exists(Path(name)) and name not in (shipped := shipped_priors()):
        raise unknown_name("prior", name, shipped)


def _check_reward(reward: Any, config_dir: str) -> None:
    if "rewards.registry" in sys.modules:  # this process may have registered more
        return
    name = reward.get("name") if isinstance(reward, dict) and set(reward) == {"name"} else reward
    if isinstance(name, str) and name.isidentifier() and name not in (known := known_rewards(config_dir)):
        raise unknown_name("reward", name, known)
