"""Prompts as conditions: words, padding, guidance, and what happens to words that are not known."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
import torch

from agents.networks import MixedFluxConfig, TextConfig, TextEncoder
from agents.networks.text import number_features, vocabulary
from agents.pretraining.initial_prior import build_prior
from agents.pretraining.settings import PretrainConfig
from agents.priors.config import MixedPriorConfig
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch

PROMPTS = ["A scene with 12 objects.", "A scene with two cups and a table."]


@pytest.fixture(scope="module")
def prior() -> MixedPrior:
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 8)
    prompts = describe_all(scenes, np.random.default_rng(0))
    config = PretrainConfig(text="vocabulary", network={"hidden": 32, "depth": 2, "heads": 2})
    made = build_prior(config, scenes.tensor, Normalizer.fit(scenes.tensor), prompts)
    assert isinstance(made, MixedPrior)
    generator = torch.Generator().manual_seed(0)
    for parameter in made.parameters():
        if not bool(parameter.any()):
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    return made.eval()


@pytest.mark.parametrize(("latents", "window", "count_tokens"), [(0, 1, 0), (4, 1, 8), (0, 3, 0), (4, 5, 0)])
def test_padding_changes_nothing_in_the_encoder(latents: int, window: int, count_tokens: int) -> None:
    size: dict[str, Any] = {
        "latents": latents,
        "window": window,
        "count_tokens": count_tokens,
        "numbers": count_tokens > 0,
    }
    encoder = TextEncoder(TextConfig(vocabulary(PROMPTS), width=16, heads=2, **size)).eval()
    alone, _ = encoder(PROMPTS[:1])
    tokens, mask = encoder([PROMPTS[0], PROMPTS[1] + " " + PROMPTS[1]])
    assert tokens.shape[1] == (latents + count_tokens or 19)
    torch.testing.assert_close(tokens[:1, : alone.shape[1]], alone, atol=1e-5, rtol=1e-4)
    assert bool(mask[0].all()) == bool(latents)


def test_prompts_of_many_lengths_are_read_as_one_by_one() -> None:
    prompts = [" ".join(["two cups and"] * (1 + number % 7)) for number in range(24)]
    encoder = TextEncoder(TextConfig(vocabulary(prompts), width=16, heads=2, latents=4, window=3)).eval()
    alone = torch.cat([encoder([prompt])[0] for prompt in prompts])
    torch.testing.assert_close(encoder(prompts)[0], alone, atol=1e-5, rtol=1e-4)


def test_padding_changes_nothing_in_the_network(prior: MixedPrior) -> None:
    x, t = prior.initial(1, 34, torch.Generator().manual_seed(0)), torch.tensor([500])
    tokens, mask = prior.encode_prompts(PROMPTS[:1])
    alone = prior.denoiser(x, t, prior.observed_entries(x), (tokens, mask))
    padding = torch.full((1, 5, tokens.shape[-1]), 7.0)
    padded = torch.cat([tokens, padding], dim=1), torch.cat([mask, torch.zeros(1, 5, dtype=torch.bool)], dim=1)
    for first, second in zip(alone, prior.denoiser(x, t, prior.observed_entries(x), padded), strict=True):
        torch.testing.assert_close(first, second, atol=1e-5, rtol=1e-4)


def test_the_prompt_and_the_order_of_its_words_matter(prior: MixedPrior) -> None:
    encoder = prior.denoiser.text_encoder
    assert encoder is not None
    tokens, _ = encoder(["two cups and a table", "a table and two cups"])
    assert not torch.allclose(tokens[0].mean(dim=0), tokens[1].mean(dim=0), atol=1e-4)
    first, second = (prior.sample(2, prompt=prompt, num_steps=4, seed=0) for prompt in PROMPTS)
    assert not torch.equal(first.tensor, second.tensor)


def test_guidance_follows_its_formula(prior: MixedPrior) -> None:
    x, table, w = prior.initial(2, 34, torch.Generator().manual_seed(0)), prior.step_table(4), 1.5
    text, t = prior.encode_prompts(PROMPTS), torch.tensor([1000, 1000])
    pose, logits = prior.denoiser(x, t, prior.observed_entries(x), text)
    free_pose, free_logits = prior.denoiser(x, t, prior.observed_entries(x), prior.encode_prompts(["", ""]))
    guided = prior.transition(x, 0, table, text=text, guidance=w)
    mean, _ = prior.process.posterior(x[..., :12], (1 + w) * pose - w * free_pose, 1000, int(table.previous[0]))
    known = prior.known(34)[:, :12]
    torch.testing.assert_close(guided.mean[:, ~known], mean[:, ~known], atol=1e-5, rtol=1e-4)
    mixed = (1 + w) * logits.log_softmax(-1) - w * free_logits.log_softmax(-1)
    mixed[..., list(prior.scene_type.fixed_categories)] = -torch.inf  # no second table
    probs = prior.categories.posterior(torch.full((2, 33), 8), mixed.softmax(-1)[:, 1:], 1000, int(table.previous[0]))
    torch.testing.assert_close(guided.probs[:, 1:], probs, atol=1e-5, rtol=1e-4)


def test_the_unconditional_branch_runs_only_when_guidance_needs_it(
    prior: MixedPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    forward = type(prior.denoiser.network).forward
    monkeypatch.setattr(
        type(prior.denoiser.network), "forward", lambda self, *a, **k: calls.append(1) or forward(self, *a, **k)
    )
    for guidance, expected in ((0.0, 3), (1.0, 6)):
        calls.clear()
        prior.sample(1, prompt=PROMPTS[0], guidance=guidance, num_steps=3)
        assert len(calls) == expected


def test_unknown_words_are_listed_and_long_prompts_refused(prior: MixedPrior, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        prior.sample(1, prompt="A scene with a zeppelin and a table.", num_steps=1)
    assert "zeppelin" in caplog.text
    assert "table" not in caplog.text
    with pytest.raises(InvalidInputError, match="at most 127"):
        prior.sample(1, prompt="a " * 200, num_steps=1)
    with pytest.raises(InvalidInputError, match=r"asks for 200 objects, a scene has 34 slots; give slots=200"):
        prior.sample(1, prompt="A scene with 200 objects.", num_steps=1)
    prior.sample(1, prompt="A scene with 40 objects.", num_steps=1, slots=40)
    with pytest.raises(InvalidInputError, match="2 prompts for 3 scenes"):
        prior.sample(3, prompt=PROMPTS, num_steps=1)
    with pytest.raises(InvalidInputError, match="trained without text"):
        tiny_prior(process="mixed").sample(1, prompt=PROMPTS[0], num_steps=1)
    with pytest.raises(InvalidInputError, match="trained without text"):
        tiny_prior().sample(1, prompt=PROMPTS[0], num_steps=1)


def test_vocabulary_and_encoder_survive_a_file(prior: MixedPrior, tmp_path: object) -> None:
    again = ScenePrior.load(prior.save(str(tmp_path)))
    assert again.conditional
    first, second = (p.sample(2, prompt=PROMPTS, guidance=0.5, num_steps=3, seed=1) for p in (prior, again))
    assert torch.equal(first.tensor, second.tensor)


def test_training_further_lists_the_words_that_the_prior_lacks(
    prior: MixedPrior, tmp_path: object, caplog: pytest.LogCaptureFixture
) -> None:
    prior.save(str(tmp_path))
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 8)
    config = PretrainConfig(prior=str(tmp_path), text="vocabulary")
    with caplog.at_level(logging.WARNING):
        build_prior(config, scenes.tensor, Normalizer.fit(scenes.tensor), [("A zeppelin over 12 cups.",)] * 8)
    assert "over, zeppelin" in caplog.text


@pytest.mark.slow
def test_a_short_training_teaches_what_prompts_say() -> None:
    """Of two kinds of scenes, told apart by prompts alone, the right prompt explains one better than the wrong one."""
    many = get_grammar("dimsum_table").sample(np.random.default_rng(0), 64).tensor[:, :12]
    few = many.clone()
    few[:, 3:] = 0.0
    few[:, 3:, -1] = 1.0  # the table and two more
    raw = torch.cat([many, few])
    prompts = [("A scene with many objects.",)] * 64 + [("A scene with 3 objects.",)] * 64
    config = PretrainConfig(
        network={"hidden": 32, "depth": 1, "heads": 2},
        text={"encoder": "vocabulary", "vocabulary": {"width": 32, "depth": 1, "latents": 4}},
    )
    made = build_prior(config, raw, Normalizer.fit(raw), prompts)
    assert isinstance(made, MixedPrior)
    x0 = made.encode(SceneBatch(raw, made.scene_type))
    optimizer, generator = torch.optim.Adam(made.parameters(), lr=3e-3), torch.Generator().manual_seed(0)
    for _ in range(30):
        rows = torch.randint(128, (16,), generator=generator)
        text = made.encode_prompts([prompts[row][0] for row in rows])
        optimizer.zero_grad()
        made.pretraining_loss(x0[rows], generator, text=text).backward()
        optimizer.step()
    start = torch.full((128,), made.config.num_timesteps)  # everything is masked
    loss = {}
    for name, told in (("right", prompts), ("wrong", prompts[::-1])):
        text = made.encode_prompts([group[0] for group in told])
        with torch.no_grad():
            loss[name] = float(made.pretraining_loss(x0, torch.Generator().manual_seed(1), t=start, text=text))
    assert loss["right"] < loss["wrong"] - 0.2


def test_a_vocabulary_holds_the_words_of_prompts_and_all_counts() -> None:
    words = vocabulary(PROMPTS)
    assert {"a", "scene", "cups", "12", "125", "."} <= set(words)
    encoder = TextEncoder(TextConfig(words, width=16, heads=2))
    indices, unknown = encoder.tokenize(PROMPTS)
    assert indices.shape[0] == 2
    assert unknown == []


def test_numbers_say_how_many_they_are_however_they_are_written() -> None:
    for words in (("a", "an", "one", "1"), ("three", "3"), ("twenty", "20")):
        assert len({tuple(number_features(word)) for word in words}) == 1
    sizes = [number_features(str(number))[1] for number in (0, 1, 2, 33)]
    assert sizes == [0.0, 1 / 16, 2 / 16, 33 / 16]
    assert not any(number_features("cup"))


def test_what_is_asked_of_things_needs_latents() -> None:
    with pytest.raises(InvalidInputError, match="give latents"):
        TextConfig(words=("cup",), latents=0, count_tokens=8)


def test_a_window_of_words_is_odd() -> None:
    with pytest.raises(InvalidInputError, match="window of 2 words: give an odd number"):
        TextConfig(words=("cup",), window=2)


def test_a_network_with_text_has_double_blocks_and_one_without_has_none() -> None:
    with_text = MixedPriorConfig("dimsum_table", 34, MixedFluxConfig(8, text_width=16))
    assert with_text.network.double_blocks > 0
    assert len(tiny_prior(process="mixed").denoiser.network.double_blocks) == 0
