"""``scene-envs check-reward``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agents.configuration.fields import named

WRITES = False


@dataclass
class CheckRewardConfig:
    """A reward under test.

    Attributes:
        reward: its name, or a mapping such as '{name: clip, reward: object_count, high: 20}'.
        scene: the scene type to try it on.
        seed: of the scenes it is tried on.
    """

    reward: Any = named("object_count", "reward")
    scene: Any = named("dimsum_table", "scene")
    seed: int = 0


def config() -> type[CheckRewardConfig]:
    """The keys of this command."""
    return CheckRewardConfig


def run(settings: CheckRewardConfig) -> None:
    """Print what was checked; raises RewardError with every broken clause."""
    from rewards import check_reward, reward_name

    for clause in check_reward(settings.reward, settings.scene, seed=settings.seed):
        print(f"ok  {clause}")
    print(f"reward {reward_name(settings.reward)!r} keeps its contract")
