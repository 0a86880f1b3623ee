"""``scene-envs rewards``."""

from __future__ import annotations

from agents.configuration.composition import RewardLimitKeys

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
