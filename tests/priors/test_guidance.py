"""Guidance by numbers, the least change of probabilities that meets bounds, and by physics: when it moves objects."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from agents import ScenePrior
from agents.configuration.prior_names import list_priors
from agents.priors.card import package_prior
from agents.priors.files import read_config
from agents.priors.guidance import NumberGuidance, PhysicsGuidance, kind_weights, number_bounds
from agents.priors.testing import tiny_prior
from scene_envs.datasets import describe, parse_prompt, scene_facts
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics import feasibility, penetration
from scene_envs.physics.correction import corrections
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE
from tests.helpers.simple_scenes import scene as boxes

INF = math.inf


def tilted(probs: Tensor, weights: Tensor) -> Tensor:
    """(B, N, R) probabilities with the factors of the kinds."""
    raw = probs * weights.unsqueeze(1)
    return raw / raw.sum(dim=-1, keepdim=True)


def random_probs(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.softmax(2 * torch.randn(*shape, generator=generator, dtype=torch.float64), dim=-1)


# -- factors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ([3.0, 0.0, 0.0, 0.0], [3.0, INF, INF, INF]),
        ([0.0, 4.0, 0.0, 0.0], [INF, INF, 1.0, INF]),
        ([2.0, 1.0, 3.0, 2.0], [2.0, 1.0, 3.0, 2.0]),
        ([0.0, 0.0, 0.0, 0.0], [0.0, INF, INF, INF]),
        ([8.0, 0.0, 0.0, 0.0], [8.0, INF, INF, INF]),
    ],
)
def test_expected_numbers_meet_their_bounds(low: list[float], high: list[float]) -> None:
    probs = random_probs(5, 8, 4)
    least, most = (torch.tensor([bound] * 5, dtype=torch.float64) for bound in (low, high))
    number = tilted(probs, kind_weights(probs, least, most)).sum(dim=1)
    assert bool((number > least - 1e-3).all())
    assert bool((number < most + 1e-3).all())


def test_numbers_within_their_bounds_change_nothing() -> None:
    probs = random_probs(3, 8, 4)
    number = probs.sum(dim=1)
    torch.testing.assert_close(kind_weights(probs, number - 0.1, number + 0.1), torch.ones(3, 4, dtype=torch.float64))


def test_no_other_probabilities_within_the_bounds_are_closer_to_those_of_the_prior() -> None:
    probs = random_probs(1, 4, 3, seed=2)
    low, high = torch.tensor([[2.0, 0.0, 0.0]]), torch.tensor([[2.0, 0.5, INF]])
    found = tilted(probs, kind_weights(probs, low, high))[0].numpy()
    prior = probs[0].numpy()

    def divergence(flat: np.ndarray) -> float:
        other = flat.reshape(4, 3)
        return float((other * np.log(other / prior)).sum())

    best = minimize(
        divergence,
        np.full(12, 1 / 3),
        bounds=[(1e-9, 1)] * 12,
        constraints=[
            {"type": "eq", "fun": lambda flat: flat.reshape(4, 3).sum(axis=1) - 1},
            {"type": "eq", "fun": lambda flat: flat.reshape(4, 3)[:, 0].sum() - 2},
            {"type": "ineq", "fun": lambda flat: 0.5 - flat.reshape(4, 3)[:, 1].sum()},
        ],
        options={"ftol": 1e-12, "maxiter": 500},
    )
    assert divergence(found.ravel()) == pytest.approx(best.fun, abs=1e-4)
    np.testing.assert_allclose(found, best.x.reshape(4, 3), atol=5e-3)


def test_bounds_that_no_scene_can_meet_are_approached() -> None:
    probs = random_probs(1, 3, 3)
    few = torch.tensor([[4.0, 2.0, 0.0]])
    number = tilted(probs, kind_weights(probs, few, few)).sum(dim=1)[0]
    assert float(number[0]) > float(number[1]) > 0.5
    assert float(number[2]) < 1e-3
    never = torch.tensor([[[0.0, 0.5, 0.5]]], dtype=torch.float64)  # the first kind is closed
    weights = kind_weights(never, torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[1.0, INF, INF]]))
    torch.testing.assert_close(tilted(never, weights), never)


# -- bounds -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scene_type", "text", "bounds"),
    [
        ("dimsum_table", "A scene with 12 objects.", {"": (12, 12)}),
        ("dimsum_table", "A scene with a table and two cups.", {"table": (1, 1), "cup": (2, 2)}),
        ("dimsum_table", "A scene where the teapot is behind the second cup from the left.",
         {"teapot": (1, 1), "cup": (2, INF)}),
        ("dimsum_table", "A scene where two steamer lids are each on top of a steamer bottom.",
         {"steamer lid": (2, INF), "steamer bottom": (2, INF)}),
        ("dimsum_table", "A scene where two steamer bottoms are each on top of a steamer bottom.",
         {"steamer bottom": (3, INF)}),
        ("living_room_shelf", "A scene where two apples are in the bowl.", {"apple": (2, INF), "bowl": (1, 1)}),
        ("living_room_shelf", "A scene where three coke cans are on the top shelf.",
         {"coke can": (3, INF), "shelf": (1, 1)}),
        ("restaurant_low_clutter", "A scene where two plates are on the second table from the left.",
         {"plate": (2, INF), "table": (2, INF)}),
    ],
)  # fmt: skip
def test_claims_bound_the_numbers_of_their_things(
    scene_type: str, text: str, bounds: dict[str, tuple[float, float]]
) -> None:
    assert number_bounds(parse_prompt(text, scene_type).claims) == bounds


# -- samples ----------------------------------------------------------------------------------------


def followed(batch: SceneBatch, prompts: list[str]) -> float:
    checks = [parse_prompt(p, batch.scene_type).holds(s) for p, s in zip(prompts, scene_facts(batch), strict=True)]
    return float(np.mean(checks))


@pytest.mark.parametrize("kind", ["count", "names"])
@pytest.mark.parametrize("scene_type", ["dimsum_table", "restaurant_low_clutter"])
def test_an_untrained_prior_holds_the_numbers_of_its_prompts(scene_type: str, kind: str) -> None:
    prior = tiny_prior(scene_type, process="mixed", text=True, kernel="squared_absorbing")
    rng = np.random.default_rng(0)
    prompts = describe(get_grammar(scene_type).sample(rng, 3), rng, kinds=[kind])
    assert followed(prior.sample(3, prompt=prompts, num_steps=4), prompts) < 0.5
    assert followed(prior.sample(3, prompt=prompts, claim_guidance=1.0, num_steps=20), prompts) == 1.0


def test_objects_that_are_kept_count() -> None:
    prior = tiny_prior(process="mixed", text=True, kernel="squared_absorbing")
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(1), 4)
    wanted = int(scenes.counts.max()) + 3
    full = prior.complete(scenes, prompt=f"A scene with {wanted} objects.", claim_guidance=1.0, num_steps=20)
    assert full.counts.tolist() == [wanted] * 4
    assert torch.equal(full.tensor[~scenes.is_empty], scenes.tensor[~scenes.is_empty])
    nothing = prior.complete(scenes, prompt="A scene with two objects.", claim_guidance=1.0, num_steps=10)
    assert torch.equal(nothing.tensor, scenes.tensor)


def test_categories_that_are_replaced_are_drawn_as_before() -> None:
    prior = tiny_prior(process="mixed", text=True, kernel="mask_and_replace")
    prompt = "A scene with 12 objects."
    plain = prior.sample(2, prompt=prompt, num_steps=4)
    assert torch.equal(plain.tensor, prior.sample(2, prompt=prompt, claim_guidance=1.0, num_steps=4).tensor)


@pytest.mark.parametrize("prompt", ["", "no such phrase"])
def test_a_scene_does_not_depend_on_the_prompt_of_its_neighbour(prompt: str) -> None:
    prior = tiny_prior(process="mixed", text=True, kernel="squared_absorbing")

    def beside(other: str) -> SceneBatch:
        return prior.sample(2, prompt=[prompt, other], claim_guidance=1.0, num_steps=10, seed=4)

    first, second = beside("A scene with 12 objects."), beside("A scene with 20 objects.")
    assert torch.equal(first.categories[0], second.categories[0])
    assert (int(first.counts[1]), int(second.counts[1])) == (12, 20)


def test_the_chance_of_a_slot_to_be_unmasked_stays() -> None:
    prior = tiny_prior(process="mixed", text=True, kernel="squared_absorbing")
    x, table = prior.initial(2, 34), prior.step_table(10)
    step = prior.transition(x, 0, table)
    other = NumberGuidance(["A scene with three cups.", ""], "dimsum_table")(x, step)
    torch.testing.assert_close(other.probs[..., -1], step.probs[..., -1])  # type: ignore[attr-defined]
    torch.testing.assert_close(other.probs.sum(dim=-1), torch.ones(2, 34))  # type: ignore[attr-defined]
    assert torch.equal(other.probs[1], step.probs[1])  # type: ignore[attr-defined]
    assert not torch.equal(other.probs[0], step.probs[0])  # type: ignore[attr-defined]


STD = torch.tensor([0.01, 0.01, 0.001])


@pytest.fixture(scope="module")
def overlapping() -> SceneBatch:
    return boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.01, 0.03, 0.0))


def test_moves_are_the_corrections_times_the_strength(overlapping: SceneBatch) -> None:
    moves = corrections(overlapping, STD)
    for strength in (1.0, 0.5):
        shift = PhysicsGuidance(strength)(40, 50, lambda: overlapping, STD)
        assert shift is not None
        torch.testing.assert_close(shift, strength * moves)
    assert moves.abs().max() > 0.004


def test_further_rounds_at_the_last_step_take_apart_what_one_round_leaves() -> None:
    """Scenes of the grammar whose objects were moved by a centimetre: no step follows that could adapt them."""
    scenes = get_grammar("breakfast_table_low_clutter").sample(np.random.default_rng(0), 32)
    noise = 0.01 * torch.randn(scenes.translations.shape, generator=torch.Generator().manual_seed(0))
    rough = scenes.with_poses(scenes.translations + noise * scenes.is_free[..., None], scenes.rotations)

    def colliding(step: int) -> int:
        moves = PhysicsGuidance(1.0)(step, 50, lambda: rough, STD)
        pairs = penetration(rough.with_poses(rough.translations + moves, rough.rotations)).pairs
        return sum(any(pair.depth > 1e-3 for pair in scene) for scene in pairs)

    assert colliding(48) >= 2
    assert colliding(49) == 0


def test_what_floats_high_comes_down_at_the_last_step_only() -> None:
    """10 cm above another cube, and 40 cm above it."""
    for height, fall in ((0.1, 0.1), (0.4, 0.0)):
        scene = boxes(("cube", 0.0, 0.0, 0.0), ("cube", 0.0, 0.0, SIDE + height))
        guidance = PhysicsGuidance(1.0)
        assert not guidance(48, 50, lambda scene=scene: scene, STD).any()
        torch.testing.assert_close(
            guidance(49, 50, lambda scene=scene: scene, STD)[0, 2], torch.tensor([0.0, 0.0, -fall]), atol=1e-4, rtol=0.0
        )


def test_nothing_moves_while_positions_are_uncertain(overlapping: SceneBatch) -> None:
    assert not PhysicsGuidance.acts(torch.tensor([0.01, 0.04, 0.001]))
    assert PhysicsGuidance.acts(torch.tensor([0.01, 0.01, 0.3]))
    high = PhysicsGuidance(1.0)(0, 50, lambda: overlapping, torch.tensor([0.01, 0.01, 0.3]))  # tiers of a shelf
    assert high is not None


def test_slots_that_are_not_denoised_stay(overlapping: SceneBatch) -> None:
    movable = torch.arange(overlapping.tensor.shape[1])[None] != 1
    shift = PhysicsGuidance(1.0, movable)(49, 50, lambda: overlapping, STD)
    assert shift is not None
    assert not shift[0, 1].any()
    assert shift[0, 2].any()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dimsum_table", "dimsum_table_continuous", "living_room_shelf"])
def test_samples_have_more_feasible_objects(name: str) -> None:
    pytest.importorskip("pybullet")
    prior = ScenePrior.load(name)
    share = []
    for strength in (0.0, 1.0):
        batch = prior.sample(6, num_steps=16, seed=2, physics_guidance=strength)
        share.append(float(feasibility(batch).feasible[batch.is_free].double().mean()))
    assert share[1] > share[0] + 0.05, share
    assert share[1] > 0.8, share


def test_without_guidance_no_bit_changes_and_with_it_welded_objects_stay() -> None:
    prior = ScenePrior.load("living_room_shelf")
    plain, none, guided = (
        prior.sample(2, num_steps=6, **how) for how in ({}, {"physics_guidance": 0.0}, {"physics_guidance": 1.0})
    )
    assert torch.equal(plain.tensor, none.tensor)
    assert not torch.equal(plain.translations, guided.translations)
    welded = plain.scene_type.welded_categories
    fixed = torch.isin(guided.categories, torch.tensor(list(welded)))
    assert torch.equal(guided.translations[fixed], plain.translations[fixed])


def test_a_prior_may_name_the_strength_of_callers_that_give_none(tmp_path: Path) -> None:
    prior = tiny_prior("dimsum_table", process="mixed")
    scenes = {strength: prior.sample(3, num_steps=6, physics_guidance=strength) for strength in (0.0, 1.0)}
    moved = {strength: prior.rearrange(scenes[0.0], num_steps=6, physics_guidance=strength) for strength in (0.0, 1.0)}
    assert not torch.equal(scenes[0.0].tensor, scenes[1.0].tensor)
    guided = ScenePrior.load(package_prior(prior, tmp_path / "guided", precision="float32", physics_guidance=1.0))
    assert prior.config.physics_guidance == 0
    assert guided.config.physics_guidance == 1
    for strength, expected in ((None, 1.0), (0.0, 0.0)):
        assert torch.equal(guided.sample(3, num_steps=6, physics_guidance=strength).tensor, scenes[expected].tensor)
        again = guided.rearrange(scenes[0.0], num_steps=6, physics_guidance=strength)
        assert torch.equal(again.tensor, moved[expected].tensor)
    with pytest.raises(InvalidInputError, match="physics_guidance=2 must be a number from 0 to 1"):
        guided.with_physics_guidance(2)


def test_shipped_priors_that_were_trained_to_be_feasible_are_guided() -> None:
    strengths = {name: read_config(name)["prior"].get("physics_guidance", 0.0) for name in list_priors()}
    assert strengths == {name: float(name.endswith("_feasible")) for name in strengths}


def test_completions_keep_what_is_observed_bit_for_bit() -> None:
    prior = ScenePrior.load("living_room_shelf")
    scenes = prior.sample(2, num_steps=6, seed=5)
    completed = prior.complete(scenes, fill=4, num_steps=6, physics_guidance=1.0)
    kept = ~scenes.is_empty
    assert torch.equal(completed.tensor[kept], scenes.tensor[kept])
    moved = prior.rearrange(scenes, num_steps=6, physics_guidance=1.0)
    assert torch.equal(moved.categories, scenes.categories)
    assert torch.equal(moved.tensor[~scenes.is_free], scenes.tensor[~scenes.is_free])


def test_guided_samples_of_an_untrained_prior_repeat_and_are_finite() -> None:
    prior = tiny_prior("dimsum_table", process="mixed")
    first, second = (prior.sample(3, num_steps=6, physics_guidance=1.0).tensor for _ in range(2))
    assert torch.equal(first, second)
    assert torch.isfinite(first).all()


@pytest.mark.parametrize("strength", [-0.5, 1.5, math.nan, math.inf, True, "1"])
def test_strengths_outside_zero_to_one_are_refused(strength: float) -> None:
    prior = tiny_prior()
    with pytest.raises(InvalidInputError, match=r"physics_guidance=.* must be a number from 0 to 1"):
        prior.sample(1, num_steps=2, physics_guidance=strength)
    with pytest.raises(InvalidInputError, match="physics_guidance="):
        prior.complete(SceneBatch.empty("dimsum_table", 1), num_steps=2, physics_guidance=strength)
