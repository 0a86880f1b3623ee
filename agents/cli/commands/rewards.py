"""``scene-envs rewards``."""

from __future__ import annotations

from dataclasses import dataclass

WRITES = False


@dataclass
class RewardsConfig:
    """No keys."""


def run(settings: RewardsConfig) -> None:
    """Print every reward with its settings and where it comes from."""
    from rewards import list_rewards, reward_info
    from scene_envs.errors import RewardError

    for name in list_rewards():
        try:
            info = reward_info(name)
        except RewardError as error:
            print(f"{name}: cannot be used. {error}")
            continue
        print(f"{name}: {info.summary or 'no description.'}")
        if info.parameters:
            print(f"    settings: {', '.join(info.parameters)}")
        if info.source.split(".")[0] != "rewards":
            print(f"    from: {info.source}")
