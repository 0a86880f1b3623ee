"""``scene-envs rewards`` and ``check-reward``."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

from agents.configuration.composition import RewardLimitKeys, named
from scene_envs.errors import Seed

WRITES = False


def run(settings: RewardLimitKeys) -> None:
    """Print every reward with its settings and where it comes from."""
    from rewards import list_rewards
    from rewards.process import describe_rewards

    for name, info, problem in describe_rewards(list_rewards(), **vars(settings.reward_limits)):
        if info is None:
            print(f"{name}: cannot be used. {problem}", flush=True)
            continue
        print(f"{name}: {info.summary or 'no description.'}", flush=True)
        if info.parameters:
            print(f"    settings: {', '.join(info.parameters)}")
        if info.source.split(".")[0] != "rewards":
            print(f"    from: {info.source}")


@dataclass
class CheckRewardConfig(RewardLimitKeys):
    """A reward under test.

    Attributes:
        reward: name of the reward, or a mapping such as '{name: clip, reward: object_count, high: 20}'.
        scene: scene type of the test scenes.
        seed: seed of the test scenes.
    """

    reward: Any = named("object_count", "reward")
    scene: Any = named("dimsum_table", "scene")
    seed: Seed = 0


def run_check_reward(settings: CheckRewardConfig) -> None:
    """Print what was checked; raises RewardError with every broken clause."""
    from rewards import check_reward, reward_name
    from rewards.process import close_reward, run_reward

    reward = run_reward(settings.reward, **vars(settings.reward_limits))
    try:
        for clause in check_reward(reward, settings.scene, seed=settings.seed):
            print(f"ok  {clause}")
    finally:
        close_reward(reward)
    print(f"reward {reward_name(settings.reward)!r} keeps its contract")


check_reward = SimpleNamespace(run=run_check_reward, WRITES=False)
