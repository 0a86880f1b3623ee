"""The mixed prior: chains, inpainting, environments and gradients; prompts by vocabulary and by BERT."""

from __future__ import annotations

import json
import logging
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents.configuration.composition import changed
from agents.diffusion import MixedStep
from agents.diffusion.reverse_steps import state_of
from agents.networks import MixedFluxConfig, TextConfig, TextEncoder
from agents.networks.denoisers import Observed
from agents.networks.text import number_features, vocabulary
from agents.networks.text_encoders import FOLDER_VARIABLE, load_bert
from agents.post_training import DDPOSFLoss, DenoisingPolicy
from agents.post_training.rollouts import collect
from agents.post_training.settings import DDPOSFSettings, NFTSettings, make_algorithm
from agents.pretraining.initial_prior import build_prior
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import pretrain
from agents.priors.card import package_prior
from agents.priors.checkpoint_import import import_checkpoint
from agents.priors.config import MixedPriorConfig
from agents.priors.files import PriorFacts
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.datasets.prompts import describe_all
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError, MissingDependencyError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.authors_flux import random_state, write_checkpoint
from tests.helpers.small_bert import write_bert

MASK = 8


@pytest.fixture(scope="module")
def prior() -> MixedPrior:
    made = tiny_prior(process="mixed")
    assert isinstance(made, MixedPrior)
    return made


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)


@pytest.mark.parametrize(("share", "expected"), [(0.0, 0.5), (0.5, 0.25), (1.0, 0.0)])
def test_a_share_of_the_completions_in_training_observes_no_empty_slot(
    prior: MixedPrior, share: float, expected: float
) -> None:
    """Completions observe whole slots, by shares that are uniform: half of the objects, and half of the empty slots."""
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(1), 8)
    config, x0 = prior.config, prior.encode(batch).repeat(200, 1, 1)
    try:
        prior.config = replace(config, observed_share=1.0)
        observed = prior.with_open_empty(share).draw_observed(x0, torch.Generator().manual_seed(0))
    finally:
        prior.config = config
    alike = (observed.pose == observed.category).all(dim=1) & ~observed.category.all(dim=1)
    completions = alike & observed.pose[:, 1:].any(dim=1)  # some by chance alone: 2 of 1,000 rows
    empty = batch.is_empty.repeat(200, 1)[completions]
    free = batch.is_free.repeat(200, 1)[completions]
    assert float(observed.pose[completions][empty].float().mean()) == pytest.approx(expected, abs=0.05)
    assert float(observed.pose[completions][free].float().mean()) == pytest.approx(0.5, abs=0.05)


def test_scenes_survive_encoding_and_known_entries_are_clamped(prior: MixedPrior, scenes: SceneBatch) -> None:
    x = prior.encode(scenes)
    assert set(x[..., 12:].unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(prior.decode(x).tensor, scenes.tensor, atol=1e-6, rtol=0)
    start = prior.initial(3, 34, torch.Generator().manual_seed(0))
    assert (start[:, 0] == x[:1, 0]).all()  # the table is known from the first step
    assert (state_of(start[:, 1:, 12:]) == MASK).float().mean() > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [1, 7, 150])
def test_chains_of_any_length_end_in_scenes_without_mask_tokens(prior: MixedPrior, num_steps: int) -> None:
    table = prior.step_table(num_steps)
    x = prior.run_chain(prior.initial(2, 34), table, torch.Generator().manual_seed(0))
    assert (x[..., 12:].sum(dim=-1) == 1).all()
    assert len(prior.decode(x)) == 2


def test_steps_state_their_probabilities_and_the_last_is_certain(prior: MixedPrior) -> None:
    table = prior.step_table(5)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    first, last = prior.transition(x, 0, table), prior.transition(x, 4, table)
    assert isinstance(first, MixedStep)
    torch.testing.assert_close(first.probs.sum(dim=-1), torch.ones(2, 34))
    assert first.entries == int((~prior.known(34))[:, :12].sum()) + 33
    assert last.entries == 0
    assert (last.log_prob(x) == 0).all()


def test_the_network_does_not_care_about_the_order_of_slots(prior: MixedPrior) -> None:
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    t, order = torch.tensor([900, 30]), torch.randperm(34)
    pose, logits = prior.denoiser(x, t)
    turned_pose, turned_logits = prior.denoiser(x[:, order], t)
    torch.testing.assert_close(turned_pose, pose[:, order], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(turned_logits, logits[:, order], atol=1e-5, rtol=1e-4)


def test_the_same_seed_gives_the_same_scenes_and_files_keep_them(prior: MixedPrior, tmp_path: object) -> None:
    first = prior.sample(3, num_steps=5, seed=1)
    again = ScenePrior.load(prior.save(str(tmp_path))).sample(3, num_steps=5, seed=1)
    assert isinstance(again, SceneBatch)
    assert (first.tensor == again.tensor).all()
    assert prior.sample(1, num_steps=2, slots=40, seed=0).tensor.shape == (1, 40, 20)


def test_kept_entries_come_back_bit_identical(prior: MixedPrior, scenes: SceneBatch) -> None:
    mask = torch.zeros(6, 34, 2, dtype=torch.bool)
    mask[:, 1:6, 0], mask[:, 4:9, 1] = True, True
    changed = prior.inpaint(scenes, mask, num_steps=4, seed=3)
    poses, categories = changed.tensor[..., :12], changed.tensor[..., 12:]
    assert (poses[:, 6:] == scenes.tensor[:, 6:, :12]).all()
    assert (categories[:, :4] == scenes.tensor[:, :4, 12:]).all()
    assert (poses[:, 1:4] != scenes.tensor[:, 1:4, :12]).any()
    moved = prior.rearrange(scenes, num_steps=4)
    assert (moved.categories == scenes.categories).all()
    assert (moved.tensor[:, 0] == scenes.tensor[:, 0]).all()
    full = prior.complete(scenes, slots=40, num_steps=4)
    present = ~scenes.is_empty
    assert (full.tensor[:, :34][present] == scenes.tensor[present]).all()
    both = prior.inpaint(scenes[:2], mask[:2], num_steps=4, seed=3)
    assert (both.tensor[:, 9:] == scenes.tensor[:2, 9:]).all()


def test_given_entries_carry_no_noise_into_the_network(prior: MixedPrior, scenes: SceneBatch) -> None:
    x0 = prior.encode(scenes)
    observed = Observed(x0, torch.rand(6, 34) < 0.5, torch.rand(6, 34) < 0.5)
    seen = [
        observed.write(prior.add_noise(x0, torch.full((6,), 700), torch.randn(x0.shape)))[observed.entries()]
        for _ in range(2)
    ]
    assert (seen[0] == seen[1]).all()
    assert (seen[0] == x0[observed.entries()]).all()


def test_fixed_objects_look_alike_in_training_and_in_chains(
    prior: MixedPrior, scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dict[str, torch.Tensor]] = []
    kind = type(prior.denoiser.network)
    forward = kind.forward

    def watched(self: torch.nn.Module, pose: torch.Tensor, *args: torch.Tensor, **more: torch.Tensor) -> object:
        seen.append({"pose": pose[0, 0], "position": more["position"][0, 0], "level": more["noise_level"][0, 0],
                     "observed": more["observed"][0, 0]})  # fmt: skip
        return forward(self, pose, *args, **more)

    monkeypatch.setattr(kind, "forward", watched)
    prior.pretraining_loss(prior.encode(scenes))
    prior.sample(2, num_steps=2)
    prior.rearrange(scenes, num_steps=1)
    assert len(seen) == 4
    for other in seen[1:]:
        for name, value in seen[0].items():
            torch.testing.assert_close(other[name], value, atol=1e-6, rtol=0)
    assert int(seen[0]["observed"]) == 3
    assert float(seen[0]["level"]) == 0.0


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_whatever_is_regenerated_objects_keep_valid_poses(process: str, scenes: SceneBatch) -> None:
    any_prior = tiny_prior(process=process)
    for column in (0, 1):
        mask = torch.zeros(6, 34, 2, dtype=torch.bool)
        mask[..., column] = True
        changed = any_prior.inpaint(scenes, mask, num_steps=3)
        assert (changed.is_empty == scenes.is_empty).all()
        turn = changed.rotations[~changed.is_empty]
        torch.testing.assert_close(turn @ turn.mT, torch.eye(3).expand_as(turn), atol=1e-5, rtol=0)


def test_bad_masks_and_names_are_refused(prior: MixedPrior, scenes: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match=r"\(6, 34, 2\)"):
        prior.inpaint(scenes, torch.zeros(6, 34, 3, dtype=torch.bool))
    with pytest.raises(UnknownNameError, match="did you mean 'mixed'"):
        tiny_prior(process="mixd")
    with pytest.raises(InvalidInputError, match="num_steps=1001"):
        prior.sample(1, num_steps=1001)


@pytest.mark.slow
def test_the_loss_is_finite_everywhere_and_falls_in_training(scenes: SceneBatch) -> None:
    prior = tiny_prior(process="mixed", seed=1)
    x0 = prior.encode(scenes)
    for t in (1, 2, 500, 999, 1000):
        assert bool(torch.isfinite(prior.pretraining_loss(x0, reduction="none", t=torch.full((6,), t))).all())
    optimizer = torch.optim.AdamW(prior.parameters(), lr=3e-3)
    generator = torch.Generator().manual_seed(0)
    losses = []
    for _ in range(60):
        loss = prior.pretraining_loss(x0.repeat(4, 1, 1), generator)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])


def test_normal_noise_reproduces_the_prior_in_the_environment(prior: MixedPrior) -> None:
    env = DenoisingTorchRLEnv(2, prior=prior, num_steps=3, action_mode="noise")
    core = env.core
    core.reset([np.random.default_rng(seed) for seed in (0, 1)])
    x, table = core.x, prior.step_table(3)
    for step in range(3):
        noise = torch.randn(2, 34, 20, generator=torch.Generator().manual_seed(step))
        x = prior.clamp(prior.transition(x, step, table).from_noise(noise))
        core.step(noise)
        assert (core.x == x).all()


def test_the_policy_gradient_reaches_poses_and_categories(prior: MixedPrior) -> None:
    env = DenoisingTorchRLEnv(4, prior=prior, num_steps=4, reward="object_count")
    policy = DenoisingPolicy(prior, 4, chunk=3)
    rollout = collect(env, policy, seed=0)
    assert len(rollout["next", "reward"][:, -1].unique()) > 1
    loss = DDPOSFLoss(policy)
    for step in range(4):
        result = loss(rollout[:, step].set("advantage", torch.tensor([1.0, -1.0, 0.5, 2.0])))
        assert float(result["log_ratio"]) < 1e-4
        result["loss_objective"].backward()
    heads = [prior.denoiser.network.pose_out[-1].weight, prior.denoiser.network.logits_out[-1].weight]
    assert all(head.grad is not None and float(head.grad.norm()) > 0 for head in heads)
    prior.zero_grad()


def test_the_probability_of_a_chain_of_states_is_that_of_bayes(prior: MixedPrior) -> None:
    """With one stride from T to 0 states are drawn from the network's own distribution of the data, but for tables."""
    x = prior.initial(1, 34, torch.Generator().manual_seed(0))
    table = prior.step_table(2)  # T -> 1 -> 0
    step = prior.transition(x, 0, table)
    _, logits = prior.denoiser(x, torch.tensor([1000]), prior.observed_entries(x))
    logits[..., prior.scene_type.assets.index("cafe_table")] = -torch.inf
    data, keep = logits.softmax(dim=-1)[0, 1:], float(prior.categories.schedule.keep[1])
    mask, rest = float(prior.categories.schedule.mask[1]), 0.0
    rest = max(0.0, 1 - keep - mask) / 8
    expected = torch.cat([keep * data + rest, torch.full((33, 1), mask)], dim=-1)
    torch.testing.assert_close(step.probs[0, 1:], expected, atol=1e-4, rtol=0)
    assert math.isclose(float(expected.detach().sum(dim=-1).mean()), 1.0, abs_tol=1e-5)


@pytest.fixture(scope="module")
def systematic() -> MixedPrior:
    """A shipped prior, whose slots draw the kinds that a prompt counts by systematic sampling."""
    prior = ScenePrior.load("dimsum_table")
    assert isinstance(prior, MixedPrior)
    assert prior.config.unmasking == "systematic"
    return prior


def test_kinds_that_a_prompt_counts_are_groups_of_their_own(systematic: MixedPrior) -> None:
    names = systematic.scene_type.assets
    text = systematic.encode_prompts(["A scene with three teapots and two cups.", "A scene with 12 objects.", ""])
    groups = systematic.denoiser.groups_by_number(text)[:, 1:]  # there is always one table
    named, counted, nothing = groups.tolist()
    teapot, cup, plate = (names.index(name) - 1 for name in ("teapot", "teacup", "dinner_plate"))
    rest = named[plate]
    assert named[teapot] != named[cup]
    assert rest not in (named[teapot], named[cup])
    assert named[-1] == rest  # the number of all objects is not given
    assert set(counted[:-1]) == {rest}
    assert counted[-1] != rest
    assert set(nothing) == {rest}


def test_systematic_sampling_follows_its_seed_and_changes_nothing_without_a_prompt(systematic: MixedPrior) -> None:
    prompt = "A scene with three teapots and two cups."
    first, again = (systematic.sample(4, prompt=prompt, num_steps=10, seed=2) for _ in range(2))
    assert torch.equal(first.tensor, again.tensor)
    even = MixedPrior.load("dimsum_table")
    even._systematic = False
    assert torch.equal(even.sample(3, num_steps=5, seed=2).tensor, systematic.sample(3, num_steps=5, seed=2).tensor)
    generators = [torch.Generator().manual_seed(seed) for seed in (5, 6, 7)]
    mask = first.is_free[:3] & (torch.arange(first.tensor.shape[1]) % 2 == 0)
    together = systematic.inpaint(first[:3], mask, prompt=prompt, num_steps=5, generators=generators)
    alone = systematic.inpaint(
        first[2], mask[2:], prompt=prompt, num_steps=5, generators=[torch.Generator().manual_seed(7)]
    )
    assert torch.equal(together[2].categories, alone.categories)
    torch.testing.assert_close(together[2].tensor, alone.tensor, atol=1e-4, rtol=0)
    assert torch.equal(together.tensor[~mask], first[:3].tensor[~mask])


def test_a_policy_draws_independently_where_log_probabilities_are_read(systematic: MixedPrior) -> None:
    """Only then is the sum over slots the log-probability of the action; own samples are drawn as users get them."""
    text = systematic.encode_prompts(["A scene with three teapots."] * 3)
    x, step = systematic.initial(3, 34, torch.Generator().manual_seed(0)), 3
    transition = systematic.transition(x, step, systematic.step_table(8), text=text)
    assert transition.groups is not None
    exact, free = (DenoisingPolicy(systematic, 8, independent=flag, chunk=2) for flag in (True, False))
    assert exact.distribution(x, step, text).groups is None
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(1))
    drawn = free.draw(x, step, text=text, noise=noise)[0]
    torch.testing.assert_close(drawn, transition.from_noise(noise), atol=1e-4, rtol=0)
    for settings, expected in ((DDPOSFSettings(), True), (NFTSettings(), False)):
        algorithm = make_algorithm(settings, DenoisingPolicy(systematic, 8), torch.ones(8))
        assert algorithm.sampling_policy.independent is expected


PROMPTS = ["A scene with 12 objects.", "A scene with two cups and a table."]


@pytest.fixture(scope="module")
def text_prior() -> MixedPrior:
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


@pytest.mark.parametrize(("latents", "window", "count_tokens"), [(2, 1, 0), (4, 1, 8), (2, 3, 0), (4, 5, 0)])
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
    assert tokens.shape[1] == latents + count_tokens
    torch.testing.assert_close(tokens[:1, : alone.shape[1]], alone, atol=1e-5, rtol=1e-4)
    assert bool(mask.all())


def test_prompts_of_many_lengths_are_read_as_one_by_one() -> None:
    prompts = [" ".join(["two cups and"] * (1 + number % 7)) for number in range(24)]
    encoder = TextEncoder(TextConfig(vocabulary(prompts), width=16, heads=2, latents=4, window=3)).eval()
    alone = torch.cat([encoder([prompt])[0] for prompt in prompts])
    torch.testing.assert_close(encoder(prompts)[0], alone, atol=1e-5, rtol=1e-4)


def test_padding_changes_nothing_in_the_network(text_prior: MixedPrior) -> None:
    x, t = text_prior.initial(1, 34, torch.Generator().manual_seed(0)), torch.tensor([500])
    tokens, mask = text_prior.encode_prompts(PROMPTS[:1])
    alone = text_prior.denoiser(x, t, text_prior.observed_entries(x), (tokens, mask))
    padding = torch.full((1, 5, tokens.shape[-1]), 7.0)
    padded = torch.cat([tokens, padding], dim=1), torch.cat([mask, torch.zeros(1, 5, dtype=torch.bool)], dim=1)
    for first, second in zip(alone, text_prior.denoiser(x, t, text_prior.observed_entries(x), padded), strict=True):
        torch.testing.assert_close(first, second, atol=1e-5, rtol=1e-4)


def test_the_prompt_and_the_order_of_its_words_matter(text_prior: MixedPrior) -> None:
    encoder = text_prior.denoiser.text_encoder
    assert encoder is not None
    tokens, _ = encoder(["two cups and a table", "a table and two cups"])
    assert not torch.allclose(tokens[0].mean(dim=0), tokens[1].mean(dim=0), atol=1e-4)
    first, second = (text_prior.sample(2, prompt=prompt, num_steps=4, seed=0) for prompt in PROMPTS)
    assert not torch.equal(first.tensor, second.tensor)


def test_guidance_follows_its_formula(text_prior: MixedPrior) -> None:
    x, table, w = text_prior.initial(2, 34, torch.Generator().manual_seed(0)), text_prior.step_table(4), 1.5
    text, t = text_prior.encode_prompts(PROMPTS), torch.tensor([1000, 1000])
    pose, logits = text_prior.denoiser(x, t, text_prior.observed_entries(x), text)
    free_pose, free_logits = text_prior.denoiser(
        x, t, text_prior.observed_entries(x), text_prior.encode_prompts(["", ""])
    )
    guided = text_prior.transition(x, 0, table, text=text, guidance=w)
    mean, _ = text_prior.process.posterior(x[..., :12], (1 + w) * pose - w * free_pose, 1000, int(table.previous[0]))
    known = text_prior.known(34)[:, :12]
    torch.testing.assert_close(guided.mean[:, ~known], mean[:, ~known], atol=1e-5, rtol=1e-4)
    mixed = (1 + w) * logits.log_softmax(-1) - w * free_logits.log_softmax(-1)
    mixed[..., list(text_prior.scene_type.fixed_categories)] = -torch.inf  # no second table
    probs = text_prior.categories.posterior(
        torch.full((2, 33), 8), mixed.softmax(-1)[:, 1:], 1000, int(table.previous[0])
    )
    torch.testing.assert_close(guided.probs[:, 1:], probs, atol=1e-5, rtol=1e-4)


def test_the_unconditional_branch_runs_only_when_guidance_needs_it(
    text_prior: MixedPrior, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    forward = type(text_prior.denoiser.network).forward
    monkeypatch.setattr(
        type(text_prior.denoiser.network), "forward", lambda self, *a, **k: calls.append(1) or forward(self, *a, **k)
    )
    for guidance, expected in ((0.0, 3), (1.0, 6)):
        calls.clear()
        text_prior.sample(1, prompt=PROMPTS[0], guidance=guidance, num_steps=3)
        assert len(calls) == expected


def test_unknown_words_are_listed_and_long_prompts_refused(
    text_prior: MixedPrior, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        text_prior.sample(1, prompt="A scene with a zeppelin and a table.", num_steps=1)
    assert "zeppelin" in caplog.text
    assert "table" not in caplog.text
    with pytest.raises(InvalidInputError, match="at most 127"):
        text_prior.sample(1, prompt="a " * 200, num_steps=1)
    with pytest.raises(InvalidInputError, match=r"asks for 200 objects, a scene has 34 slots; give slots=200"):
        text_prior.sample(1, prompt="A scene with 200 objects.", num_steps=1)
    text_prior.sample(1, prompt="A scene with 40 objects.", num_steps=1, slots=40)
    with pytest.raises(InvalidInputError, match="2 prompts for 3 scenes"):
        text_prior.sample(3, prompt=PROMPTS, num_steps=1)
    with pytest.raises(InvalidInputError, match="trained without text"):
        tiny_prior(process="mixed").sample(1, prompt=PROMPTS[0], num_steps=1)
    with pytest.raises(InvalidInputError, match="trained without text"):
        tiny_prior().sample(1, prompt=PROMPTS[0], num_steps=1)


def test_vocabulary_and_encoder_survive_a_file(text_prior: MixedPrior, tmp_path: object) -> None:
    again = ScenePrior.load(text_prior.save(str(tmp_path)))
    assert again.conditional
    first, second = (p.sample(2, prompt=PROMPTS, guidance=0.5, num_steps=3, seed=1) for p in (text_prior, again))
    assert torch.equal(first.tensor, second.tensor)


def test_training_further_lists_the_words_that_the_prior_lacks(
    text_prior: MixedPrior, tmp_path: object, caplog: pytest.LogCaptureFixture
) -> None:
    text_prior.save(str(tmp_path))
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 8)
    config = PretrainConfig(prior=str(tmp_path), text="vocabulary")
    with caplog.at_level(logging.WARNING):
        build_prior(config, scenes.tensor, Normalizer.fit(scenes.tensor), [("A zeppelin over 12 cups.",)] * 8)
    assert "over, zeppelin" in caplog.text


@pytest.mark.slow
def test_a_short_training_teaches_what_prompts_say() -> None:
    """Of two kinds of scenes, told apart by prompts alone, the right prompt explains one better than the wrong one."""
    many = get_grammar("dimsum_table").sample(np.random.default_rng(0), 32).tensor[:, :12]
    few = many.clone()
    few[:, 3:] = 0.0
    few[:, 3:, -1] = 1.0  # the table and two more
    raw = torch.cat([many, few])
    prompts = [("A scene with many objects.",)] * 32 + [("A scene with 3 objects.",)] * 32
    config = PretrainConfig(
        network={"hidden": 32, "depth": 1, "heads": 2},
        text={"encoder": "vocabulary", "vocabulary": {"width": 32, "depth": 1, "latents": 4}},
    )
    made = build_prior(config, raw, Normalizer.fit(raw), prompts)
    assert isinstance(made, MixedPrior)
    x0 = made.encode(SceneBatch(raw, made.scene_type))
    optimizer, generator = torch.optim.Adam(made.parameters(), lr=3e-3), torch.Generator().manual_seed(0)
    for _ in range(30):
        rows = torch.randint(64, (16,), generator=generator)
        text = made.encode_prompts([prompts[row][0] for row in rows])
        optimizer.zero_grad()
        made.pretraining_loss(x0[rows], generator, text=text).backward()
        optimizer.step()
    start = torch.full((64,), made.config.num_timesteps)  # everything is masked
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


def test_an_encoder_without_tokens_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="latents=0 gives no tokens"):
        TextConfig(words=("cup",), latents=0, count_tokens=8)


def test_a_window_of_words_is_odd() -> None:
    with pytest.raises(InvalidInputError, match="window of 2 words: give an odd number"):
        TextConfig(words=("cup",), window=2)


def test_a_network_with_text_has_double_blocks_and_one_without_has_none() -> None:
    with_text = MixedPriorConfig("dimsum_table", 34, MixedFluxConfig(8, text_width=16))
    assert with_text.network.double_blocks > 0
    assert len(tiny_prior(process="mixed").denoiser.network.double_blocks) == 0


@pytest.fixture(scope="module")
def bert(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("transformers")
    return write_bert(tmp_path_factory.mktemp("bert"), longest=128)


@pytest.fixture
def no_other_bert(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)


def _data() -> SceneDataset:
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 24)
    prompts = describe_all(scenes, np.random.default_rng(0))
    return SceneDataset(scenes.tensor, prompts, Normalizer.fit(scenes.tensor), scenes.scene_type)


@pytest.fixture(scope="module")
def bert_prior(bert: Path) -> MixedPrior:
    data = _data()
    config = PretrainConfig(text={"encoder": str(bert)}, network={"hidden": 32, "depth": 2, "heads": 2})
    made = build_prior(config, data.tensor, data.normalizer, data.prompt_sets)
    assert isinstance(made, MixedPrior)
    generator = torch.Generator().manual_seed(0)
    for parameter in made.parameters():
        if not bool(parameter.any()):
            torch.nn.init.normal_(parameter, std=0.1, generator=generator)
    return made.eval()


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_prompts_condition_the_network_and_bert_is_not_saved(bert_prior: MixedPrior, tmp_path: Path) -> None:
    assert bert_prior.conditional
    assert bert_prior.config.network.text_width == 24
    folder = bert_prior.save(tmp_path)
    assert PriorFacts.of(folder).text.startswith("BERT")
    assert {name for name in bert_prior.weights() if name.startswith("text_encoder.")} == {"text_encoder.nothing"}
    again = ScenePrior.load(folder)
    first, second = (p.sample(2, prompt=PROMPTS, guidance=0.5, num_steps=3, seed=1) for p in (bert_prior, again))
    assert torch.equal(first.tensor, second.tensor)
    other = bert_prior.sample(2, prompt=PROMPTS[::-1], guidance=0.5, num_steps=3, seed=1)
    assert not torch.equal(first.tensor, other.tensor)


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_without_transformers_it_is_sampled_without_prompts(
    bert_prior: MixedPrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = bert_prior.sample(2, num_steps=3, seed=1)
    bert_prior.save(tmp_path)
    monkeypatch.setitem(sys.modules, "transformers", None)
    load_bert.cache_clear()
    again = ScenePrior.load(tmp_path)
    assert torch.equal(again.sample(2, num_steps=3, seed=1).tensor, expected.tensor)
    with pytest.raises(MissingDependencyError, match=r"scene-envs\[bert\]"):
        again.sample(1, prompt=PROMPTS[0], num_steps=1)


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_another_bert_is_refused(bert_prior: MixedPrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = bert_prior.save(tmp_path / "prior")
    monkeypatch.setenv(FOLDER_VARIABLE, str(write_bert(tmp_path / "other", seed=5, longest=128)))
    with pytest.raises(InvalidInputError, match="is not the BERT"):
        ScenePrior.load(folder).sample(1, prompt=PROMPTS[0], num_steps=1)


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
@pytest.mark.slow
def test_training_reads_prompts_and_resumes_bit_for_bit(bert: Path, tmp_path: Path) -> None:
    _data().save(tmp_path / "data")
    config = PretrainConfig(
        data=str(tmp_path / "data"), text={"encoder": str(bert)}, network={"hidden": 32, "depth": 1, "heads": 2},
        iterations=4, batch_size=4, logger={"evaluate_every": 10, "checkpoint_every": 2},
        output=str(tmp_path / "whole"),
    )  # fmt: skip
    pretrain(config)
    halves = replace(config, output=str(tmp_path / "halves"))
    state = torch.load(tmp_path / "whole" / "checkpoint.pt", weights_only=False)
    assert not [name for name in state["network"] if "bert" in name or "embeddings" in name]
    flat = {"optimizer.rate.warmup": 0, "optimizer.rate.final": 1.0}
    pretrain(changed(halves, {"iterations": 2, **flat}))
    pretrain(changed(halves, flat))
    straight = changed(config, {"output": str(tmp_path / "straight"), **flat})
    pretrain(straight)
    first, second = (ScenePrior.load(tmp_path / name).weights() for name in ("halves", "straight"))
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_a_checkpoint_of_the_authors_keeps_its_prompts(bert: Path, tmp_path: Path) -> None:
    files = write_checkpoint(tmp_path, random_state(text=24))
    bert_prior = import_checkpoint(*files, scene="dimsum_table", text_encoder=str(bert))
    assert bert_prior.conditional
    again = ScenePrior.load(bert_prior.save(tmp_path / "prior"))
    first, second = (p.sample(1, prompt=PROMPTS[0], guidance=1.0, num_steps=3).tensor for p in (bert_prior, again))
    assert torch.equal(first, second)
    assert not torch.equal(first, bert_prior.sample(1, prompt=PROMPTS[1], guidance=1.0, num_steps=3).tensor)
    with pytest.raises(InvalidInputError, match="text tokens of width 10"):
        import_checkpoint(
            *write_checkpoint(tmp_path, random_state(text=10)), scene="dimsum_table", text_encoder=str(bert)
        )


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_its_tokens_reach_the_network_as_bert_gives_them(bert: Path, tmp_path: Path) -> None:
    bert_prior = import_checkpoint(
        *write_checkpoint(tmp_path, random_state(text=24)), scene="dimsum_table", text_encoder=str(bert)
    )
    loaded = load_bert(str(bert))
    read = loaded.tokenizer(PROMPTS, padding=True, return_tensors="pt")
    with torch.no_grad():
        expected = loaded.model(**read).last_hidden_state
    tokens, mask = bert_prior.encode_prompts(PROMPTS)
    torch.testing.assert_close(tokens[mask], expected[read["attention_mask"].bool()], atol=1e-5, rtol=1e-5)


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_the_configuration_names_the_model_and_its_digest(bert_prior: MixedPrior, bert: Path, tmp_path: Path) -> None:
    text = json.loads((bert_prior.save(tmp_path) / "config.json").read_text())["prior"]["text"]
    assert text["kind"] == "bert"
    assert text["model"] == str(bert)
    assert text["digest"] == load_bert(str(bert)).digest


@pytest.mark.usefixtures("few_residual_levels")
@pytest.mark.usefixtures("no_other_bert")
def test_a_shipped_prior_names_no_folder_and_finds_its_bert_all_the_same(
    bert_prior: MixedPrior, bert: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = package_prior(bert_prior, tmp_path / "given")
    assert str(bert.parent) not in (folder / "config.json").read_text() + (folder / "README.md").read_text()
    shipped = ScenePrior.load(folder)
    with pytest.raises(InvalidInputError, match=FOLDER_VARIABLE):
        shipped.sample(1, prompt=PROMPTS[0], num_steps=1)
    monkeypatch.setenv(FOLDER_VARIABLE, str(bert))
    assert len(shipped.sample(1, prompt=PROMPTS[0], num_steps=1)) == 1


CUPS_OR_NINE = ["A scene with two cups.", "A scene with 9 objects."]


@pytest.fixture(scope="module")
def strong_prior() -> MixedPrior:
    made = tiny_prior(process="mixed", text=True)
    assert isinstance(made, MixedPrior)
    generator = torch.Generator().manual_seed(0)
    for parameter in made.denoiser.network.parameters():  # strong enough for prompts to show in three steps
        torch.nn.init.normal_(parameter, std=0.2, generator=generator)
    return made


@pytest.fixture(scope="module")
def three_scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


@pytest.mark.parametrize("guidance", [0.0, 1.5])
def test_what_is_not_masked_comes_back_bit_identical(
    strong_prior: MixedPrior, three_scenes: SceneBatch, guidance: float
) -> None:
    mask = torch.zeros(3, 34, 2, dtype=torch.bool)
    mask[:, 2:6, 0], mask[:, 4:9, 1] = True, True
    changed = strong_prior.inpaint(three_scenes, mask, prompt=CUPS_OR_NINE[0], guidance=guidance, num_steps=3)
    assert (changed.tensor[:, 6:, :12] == three_scenes.tensor[:, 6:, :12]).all()
    assert (changed.tensor[:, :4, 12:] == three_scenes.tensor[:, :4, 12:]).all()
    present = ~three_scenes.is_empty
    full = strong_prior.complete(three_scenes, prompt=CUPS_OR_NINE[1], guidance=guidance, num_steps=3)
    assert (full.tensor[present] == three_scenes.tensor[present]).all()
    moved = strong_prior.rearrange(three_scenes, prompt=CUPS_OR_NINE[0], guidance=guidance, num_steps=3)
    assert (moved.categories == three_scenes.categories).all()


def test_the_prompt_of_each_scene_is_followed(strong_prior: MixedPrior, three_scenes: SceneBatch) -> None:
    each = strong_prior.rearrange(three_scenes[:2], prompt=CUPS_OR_NINE, num_steps=3, seed=1)
    same = strong_prior.rearrange(three_scenes[:2], prompt=CUPS_OR_NINE[0], num_steps=3, seed=1)
    torch.testing.assert_close(each.tensor[0], same.tensor[0], atol=1e-5, rtol=1e-5)
    assert not torch.allclose(each.tensor[1], same.tensor[1], atol=1e-4)
    nothing = strong_prior.rearrange(three_scenes[:2], prompt="", num_steps=3, seed=1)
    torch.testing.assert_close(nothing.tensor, strong_prior.rearrange(three_scenes[:2], num_steps=3, seed=1).tensor)


def test_text_is_encoded_once_and_the_other_branch_runs_only_for_guidance(
    strong_prior: MixedPrior, three_scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoder, network = type(strong_prior.denoiser.text_encoder), type(strong_prior.denoiser.network)
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
        strong_prior.complete(three_scenes, prompt=CUPS_OR_NINE[0], guidance=guidance, num_steps=3)
        assert (encodings, len(passes)) == (texts, count)
    encodings.clear()
    strong_prior.complete(three_scenes, num_steps=3)
    assert encodings == [1]


def test_without_guidance_only_the_conditional_answer_counts(strong_prior: MixedPrior) -> None:
    """w = 0 is the prompt alone, and w = -1 would be no prompt at all."""
    x, table = strong_prior.initial(2, 34, torch.Generator().manual_seed(0)), strong_prior.step_table(4)
    text = strong_prior.encode_prompts(CUPS_OR_NINE)
    pose, _ = strong_prior.denoiser(x, torch.tensor([1000, 1000]), strong_prior.observed_entries(x), text)
    plain, away, free = (
        strong_prior.transition(x, 0, table, text=words, guidance=w)
        for words, w in ((text, 0.0), (text, -1.0), (None, 0.0))
    )
    mean, _ = strong_prior.process.posterior(x[..., :12], pose, 1000, int(table.previous[0]))
    known = strong_prior.known(34)[:, :12]
    torch.testing.assert_close(plain.mean[:, ~known], mean[:, ~known], atol=0, rtol=0)
    torch.testing.assert_close(away.mean, free.mean)
    torch.testing.assert_close(away.probs, free.probs)
    assert not torch.allclose(plain.mean, free.mean)


def test_what_cannot_be_followed_is_refused(strong_prior: MixedPrior, three_scenes: SceneBatch) -> None:
    for call in (strong_prior.complete, strong_prior.rearrange):
        for settings, message in (
            ({"guidance": 1.0}, "guidance=1 strengthens a prompt, and prompt=None asks for none"),
            ({"prompt": "", "guidance": 1.0}, "guidance=1 strengthens"),
            ({"prompt": CUPS_OR_NINE[0], "guidance": math.nan}, "finite"),
            ({"prompt": CUPS_OR_NINE}, "2 prompts for 3 scenes"),
            ({"prompt": "A scene with 99 objects."}, "asks for 99 objects, a scene has 34 slots"),
        ):
            with pytest.raises(InvalidInputError, match=message):
                call(three_scenes, num_steps=1, **settings)
    for process in ("mixed", "continuous"):
        with pytest.raises(InvalidInputError, match="trained without text"):
            tiny_prior(process=process).complete(three_scenes, prompt=CUPS_OR_NINE[0], num_steps=1)
        with pytest.raises(InvalidInputError, match="guidance=2"):
            tiny_prior(process=process).sample(1, guidance=2.0, num_steps=1)
    with pytest.raises(InvalidInputError, match="process='mixed'"):
        tiny_prior(text=True)


@pytest.mark.parametrize("shape", [(3, 33), (2, 34), (3, 34, 3), (3,)])
def test_masks_of_the_wrong_shape_or_type_are_named(
    strong_prior: MixedPrior, three_scenes: SceneBatch, shape: tuple[int, ...]
) -> None:
    with pytest.raises(InvalidInputError, match=r"mask must be bool of shape \(3, 34\), or \(3, 34, 2\)"):
        strong_prior.inpaint(three_scenes, torch.zeros(shape, dtype=torch.bool), num_steps=1)
    with pytest.raises(InvalidInputError, match=r"got torch.float32 \(3, 34\)"):
        strong_prior.inpaint(three_scenes, torch.zeros(3, 34), num_steps=1)


def test_unknown_words_are_listed(
    strong_prior: MixedPrior, three_scenes: SceneBatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        strong_prior.complete(three_scenes, prompt="A scene with a zeppelin and a cup.", num_steps=1)
    assert "zeppelin" in caplog.text
    assert "cup" not in caplog.text
