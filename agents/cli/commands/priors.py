"""``scene-envs priors``."""

from __future__ import annotations

from dataclasses import dataclass

WRITES = False


@dataclass
class PriorsConfig:
    """The shipped priors and their figures.

    Attributes:
        prior: prior whose model card is shown: a shipped name, or the folder of a prior or a run; empty lists all
            shipped priors.
    """

    prior: str = ""


def run(settings: PriorsConfig) -> None:
    """Print every shipped prior with its size and its figures, or one card."""
    from agents.configuration.prior_names import find_prior, list_priors
    from agents.priors.card import README
    from agents.priors.files import PriorFacts

    if settings.prior:
        page = find_prior(settings.prior) / README
        print(page.read_text(encoding="utf-8") if page.is_file() else "\n".join(PriorFacts.of(settings.prior).lines()))
        return
    names = list_priors()
    if not names:
        print("no prior ships with this installation; train one with scene-envs pretrain")
    for name in names:
        print("\n".join(PriorFacts.of(name).lines()))
