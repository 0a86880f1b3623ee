"""``scene-envs priors``."""

from __future__ import annotations

import json
from dataclasses import dataclass

WRITES = False


@dataclass
class PriorsConfig:
    """No keys."""


def config() -> type[PriorsConfig]:
    """This command has no keys."""
    return PriorsConfig


def run(settings: PriorsConfig) -> None:
    """Print every shipped prior with the facts of its card."""
    from agents.prior_files import CONFIG_NAME, find_prior, list_priors

    names = list_priors()
    if not names:
        print("no prior ships with this installation; train one with scene-envs pretrain")
    for name in names:
        state = json.loads((find_prior(name) / CONFIG_NAME).read_text())
        card = state.get("card") or {}
        print(f"{name}: scenes of {state['prior']['scene_type']}, {state['prior']['slots']} slots")
        for key, value in card.items():
            if isinstance(value, int | float | str):
                text = f"{value:.4g}" if isinstance(value, float) else str(value)
                print(f"    {key.replace('_', ' ')}: {text}")
