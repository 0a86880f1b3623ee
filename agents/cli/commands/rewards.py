"""``scene-envs rewards``."""

from __future__ import annotations

from dataclasses import dataclass

WRITES = False


@dataclass
class RewardsConfig:
    """Settings of the listing.

    Attributes:
        reward_timeout: most seconds that the import of an installed reward may take; it runs in its own process.
    """

    reward_timeout: float = 60.0


def run(settings: RewardsConfig) -> None:
    """Print every reward with its settings and where it comes from."""
    from rewards import list_rewards
    from rewards.process import describe_rewards

    for name, info, problem in describe_rewards(list_rewards(), timeout=settings.reward_timeout):
        if info is None:
            print(f"{name}: cannot be used. {problem}", flush=True)
            continue
        print(f"{name}: {info.summary or 'no description.'}", flush=True)
        if info.parameters:
            print(f"    settings: {', '.join(info.parameters)}")
        if info.source.split(".")[0] != "rewards":
            print(f"    from: {info.source}")
