"""Real scenes of a run: those that the grammar gives, whatever is shown meanwhile."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from agents.post_training.real_scenes import _AT_ONCE, real_scenes
from agents.priors.testing import tiny_prior
from scene_envs.grammars import get_grammar


@pytest.mark.parametrize("style", ["lines", "none"])
def test_scenes_of_the_grammar_do_not_depend_on_what_is_shown(style: str) -> None:
    prior, count = tiny_prior(), _AT_ONCE + 3
    batch, prompts = real_scenes(prior, "grammar", count, seed=5, progress=style)
    drawn = get_grammar(prior.scene_type).sample(np.random.default_rng(5), count)
    assert prompts is None
    assert torch.equal(batch.tensor, drawn.with_slots(batch.tensor.shape[1]).tensor)
