"""Inpainting under prompts: what is kept, what guidance does, and what is refused."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
import torch

from agents.priors.mixed import MixedPrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch

PROMPTS = ["A scene with two cups.", "A scene with 9 objects."]


@pytest.fixture(scope="module")
def prior() -> MixedPrior:
    made = tiny_prior(process="mixed", text=True)
    assert isinstance(made, MixedPrior)
    generator = torch.Generator().manual_seed(0)
    for parameter in made.denoiser.network.parameters():  # strong enough for prompts to show in three steps
        torch.nn.init.normal_(parameter, std=0.2, generator=generator)
    return made


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


@pytest.mark.parametrize("guidance", [0.0, 1.5])
def test_what_is_not_masked_comes_back_bit_identical(prior: MixedPrior, scenes: SceneBatch, guidance: float) -> None:
    mask = torch.zeros(3, 34, 2, dtype=torch.bool)
    mask[:, 2:6, 0], mask[:, 4:9, 1] = True, True
    changed = prior.inpaint(scenes, mask, prompt=PROMPTS[0], guidance=guidance, num_steps=3)
    assert (changed.tensor[:, 6:, :12] == scenes.tensor[:, 6:, :12]).all()
    assert (changed.tensor[:, :4, 12:] == scenes.tensor[:, :4, 12:]).all()
    present = ~scenes.is_empty
    full = prior.complete(scenes, prompt=PROMPTS[1], guidance=guidance, num_steps=3)
    assert (full.tensor[present] == scenes.tensor[present]).all()
    moved = prior.rearrange(scenes, prompt=PROMPTS[0], guidance=guidance, num_steps=3)
    assert (moved.categories == scenes.categories).all()


def test_the_prompt_of_each_scene_is_followed(prior: MixedPrior, scenes: SceneBatch) -> None:
    each = prior.rearrange(scenes[:2], prompt=PROMPTS, num_steps=3, seed=1)
    same = prior.rearrange(scenes[:2], prompt=PROMPTS[0], num_steps=3, seed=1)
    torch.testing.assert_close(each.tensor[0], same.tensor[0], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(each.tensor[1], same.tensor[1], atol=1e-4)
    nothing = prior.rearrange(scenes[:2], prompt="", num_steps=3, seed=1)
    torch.testing.assert_close(nothing.tensor, prior.rearrange(scenes[:2], num_steps=3, seed=1).tensor)


def test_text_is_encoded_once_and_the_other_branch_runs_only_for_guidance(
    prior: MixedPrior, scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder, network = type(prior.denoiser.text_encoder), type(prior.denoiser.network)
    encodings: list[int] = []
    passes: list[int] = []
    encode, forward = encoder.encode, network.forward

    def watched_encode(self: torch.nn.Module, rows: torch.Tensor) -> object:
        encodings.append(len(rows))
        return encode(self, rows)

    def watched_forward(self: torch.nn.Module, *arguments: object, **more: object) -> object:
        passes.append(1)
        return forward(self, *arguments, **more)

    monkeypatch.setattr(encoder, "encode", watched_encode)
    monkeypatch.setattr(network, "forward", watched_forward)
    for guidance, texts, count in ((0.0, [1], 3), (1.0, [1, 1], 6)):
        encodings.clear()
        passes.clear()
        prior.complete(scenes, prompt=PROMPTS[0], guidance=guidance, num_steps=3)
        assert (encodings, len(passes)) == (texts, count)
    encodings.clear()
    prior.complete(scenes, num_steps=3)
    assert encodings == [1]


def test_without_guidance_only_the_conditional_answer_counts(prior: MixedPrior) -> None:
    """w = 0 is the prompt alone, and w = -1 would be no prompt at all."""
    x, table = prior.initial(2, 34, torch.Generator().manual_seed(0)), prior.step_table(4)
    text = prior.encode_prompts(PROMPTS)
    pose, _ = prior.denoiser(x, torch.tensor([1000, 1000]), prior.observed_entries(x), text)
    plain, away, free = (
        prior.transition(x, 0, table, text=words, guidance=w) for words, w in ((text, 0.0), (text, -1.0), (None, 0.0))
    )
    mean, _ = prior.process.posterior(x[..., :12], pose, 1000, int(table.previous[0]))
    known = prior.known(34)[:, :12]
    torch.testing.assert_close(plain.mean[:, ~known], mean[:, ~known], atol=0, rtol=0)
    torch.testing.assert_close(away.mean, free.mean)
    torch.testing.assert_close(away.probs, free.probs)
    assert not torch.allclose(plain.mean, free.mean)


def test_what_cannot_be_followed_is_refused(prior: MixedPrior, scenes: SceneBatch) -> None:
    for call in (prior.complete, prior.rearrange):
        for settings, message in (
            ({"guidance": 1.0}, "guidance=1 strengthens a prompt, and prompt=None asks for none"),
            ({"prompt": "", "guidance": 1.0}, "guidance=1 strengthens"),
            ({"prompt": PROMPTS[0], "guidance": math.nan}, "finite"),
            ({"prompt": PROMPTS}, "2 prompts for 3 scenes"),
            ({"prompt": "A scene with 99 objects."}, "asks for 99 objects, a scene has 34 slots"),
        ):
            with pytest.raises(InvalidInputError, match=message):
                call(scenes, num_steps=1, **settings)
    for process in ("mixed", "continuous"):
        with pytest.raises(InvalidInputError, match="trained without text"):
            tiny_prior(process=process).complete(scenes, prompt=PROMPTS[0], num_steps=1)
        with pytest.raises(InvalidInputError, match="guidance=2"):
            tiny_prior(process=process).sample(1, guidance=2.0, num_steps=1)
    with pytest.raises(InvalidInputError, match="process='mixed'"):
        tiny_prior(text=True)


@pytest.mark.parametrize("shape", [(3, 33), (2, 34), (3, 34, 3), (3,)])
def test_masks_of_the_wrong_shape_or_type_are_named(
    prior: MixedPrior, scenes: SceneBatch, shape: tuple[int, ...]
) -> None:
    with pytest.raises(InvalidInputError, match=r"mask must be bool of shape \(3, 34\), or \(3, 34, 2\)"):
        prior.inpaint(scenes, torch.zeros(shape, dtype=torch.bool), num_steps=1)
    with pytest.raises(InvalidInputError, match=r"got torch.float32 \(3, 34\)"):
        prior.inpaint(scenes, torch.zeros(3, 34), num_steps=1)


def test_unknown_words_are_listed(prior: MixedPrior, scenes: SceneBatch, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        prior.complete(scenes, prompt="A scene with a zeppelin and a cup.", num_steps=1)
    assert "zeppelin" in caplog.text
    assert "cup" not in caplog.text
