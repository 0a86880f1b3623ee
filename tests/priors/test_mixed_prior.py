"""The mixed prior: states in scenes, chains, inpainting, and its place in environment and policy gradient."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.diffusion import MixedStep
from agents.diffusion.reverse_steps import state_of
from agents.networks.denoisers import Observed
from agents.post_training import DDPOSFLoss, DenoisingPolicy
from agents.post_training.rollouts import collect
from agents.post_training.settings import DDPOSFSettings, NFTSettings, make_algorithm
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch

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
    both = prior.inpaint(scenes[:2], mask[:2], num_steps=4, seed=3, resample=2)
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
    with pytest.raises(InvalidInputError, match="resample=0"):
        prior.inpaint(scenes, torch.zeros(6, 34, dtype=torch.bool), resample=0)
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
