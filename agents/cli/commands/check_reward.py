"""``scene-envs check-reward``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agents.configuration.composition import named

WRITES = False


@dataclass
class CheckRewardConfig:
    """A reward under test.

    Attributes:
        reward: name of the reward, or a mapping such as '{name: clip, reward: object_count, high: 20}'.
        scene: scene type of the test scenes.
        seed: seed of the test scenes.
        reward_timeout: most seconds that a reward from outside this package may take; it runs in its own process.
    """

    reward: Any = named("object_count", "reward")
    scene: Any = named("dimsum_table", "scene")
    seed: int = 0
    reward_timeout: float = 60.0


def run(settings: CheckRewardConfig) -> None:
    """Print what was checked; raises RewardError with every broken clause."""
    from rewards import check_reward, reward_name
    from rewards.process import close_reward, run_reward

    reward = run_reward(settings.reward, timeout=settings.reward_timeout)
    try:
        for clause in check_reward(reward, settings.scene, seed=settings.seed):
            print(f"ok  {clause}")
    finally:
        close_reward(reward)
    print(f"reward {reward_name(settings.reward)!r} keeps its contract")
