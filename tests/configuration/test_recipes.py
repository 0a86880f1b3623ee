"""Named sets of pretraining keys."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from agents.cli.keys import compose
from agents.pretraining.initial_prior import build_prior
from agents.pretraining.settings import PretrainConfig
from agents.priors.mixed import MixedPrior
from scene_envs.errors import UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer


@pytest.mark.slow
def test_the_paper_s_recipe_is_its_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.nn.Linear, "reset_parameters", lambda self: None)  # nobody draws 88 million numbers
    config = compose("pretrain", PretrainConfig, ["recipe=paper", "text=vocabulary"])
    raw = torch.from_numpy(get_grammar("dimsum_table").sample_array(np.random.default_rng(0), 40))
    prior = build_prior(config, raw, Normalizer.fit(raw), [["A scene with 8 objects."]])
    assert isinstance(prior, MixedPrior)
    network = prior.config.network
    assert (network.hidden, network.heads, network.double_blocks, network.single_blocks) == (512, 16, 5, 10)  # type: ignore[union-attr]
    count = sum(parameter.numel() for parameter in prior.denoiser.network.parameters())
    assert count == pytest.approx(88.3e6, rel=0.05)  # of text 768 wide; ours is narrower
    beta = 1 - prior.process.schedule.alpha_bar[1:] / prior.process.schedule.alpha_bar[:-1]
    assert (float(beta[0]), float(beta[-1])) == pytest.approx((1e-4, 0.02))
    assert prior.categories.schedule.keep[1] == pytest.approx(0.99999)
    assert (prior.config.prediction, prior.config.category_loss, prior.config.clip) == ("epsilon", "bound", 1.0)


def test_keys_given_beside_a_recipe_win() -> None:
    config = compose("pretrain", PretrainConfig, ["optimizer.lr=0.5", "recipe=paper"])
    assert (config.recipe, config.optimizer.lr, config.process.schedule) == ("paper", 0.5, "linear")
    assert compose("pretrain", PretrainConfig, []) == PretrainConfig()


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'paper'"):
        compose("pretrain", PretrainConfig, ["recipe=papr"])
