"""Priors of the package: size of the files, model cards, and numbers of objects that follow the prompt."""

from __future__ import annotations

import numpy as np
import pytest

from agents.prior_names import SHIPPED, list_priors
from agents.priors.base import ScenePrior
from agents.priors.facts import PriorFacts
from scene_envs.grammars import get_grammar

READERS = [name for name in list_priors() if PriorFacts.of(name).text]
NARROWER = ("cotrained", "restaurant_high_clutter")
"""Priors that are asked for numbers of their own samples: a union has no grammar, and few real rooms are so full."""


def test_weights_of_all_priors_fit_into_64_mib() -> None:
    assert sum(file.stat().st_size for file in SHIPPED.rglob("*.safetensors")) <= 64 * 2**20


@pytest.mark.parametrize("name", list_priors())
def test_every_prior_has_a_card_with_figures_beside_those_of_real_scenes(name: str) -> None:
    card = (SHIPPED / name / "README.md").read_text()
    assert f"# Prior `{name}`" in card


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_the_number_of_objects_follows_the_prompt(name: str) -> None:
    """A small and a large number among those of real scenes, or of its own; without reading it would miss both.

    In a fifth of the steps that its card measures it with. A prior of all types has the wider spread of all, and
    misses by half of what it would without reading, or by less.
    """
    prior = ScenePrior.load(name)
    if name in NARROWER:
        free = prior.sample(8, num_steps=10, seed=0).counts.sort().values
    else:
        free = get_grammar(prior.scene_type.name).sample(np.random.default_rng(0), 8).counts.sort().values
    numbers = (int(free[1]), int(free[-2]))
    prompts = [f"A scene with {asked} objects." for asked in numbers for _ in range(4)]
    read = prior.sample(len(prompts), prompt=prompts, guidance=1.0, num_steps=10, seed=1).counts
    missed, unread = [], []
    for asked, counts in zip(numbers, read.split(4), strict=True):
        missed.append(float((counts - asked).abs().float().mean()))
        unread.append(float((free - asked).abs().float().mean()))
    if "+" not in prior.scene_type.name:
        assert max(missed) < max(1.0, 0.4 * float(free.float().std()))
    assert sum(missed) < max(2.0, 0.5 * sum(unread))
