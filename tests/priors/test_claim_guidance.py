"""Claim guidance: closed forms of its moves, scenes that come to hold their claims, and what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm
from torch import Tensor

from agents import ScenePrior
from agents.priors.claim_guidance import ClaimGuidance, probability_slope
from agents.priors.testing import tiny_prior
from scene_envs.datasets import describe, parse_prompt, scene_facts
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.prompts_scenes import BOTTOM, TOP, build

STD = torch.full((3,), 0.03)


def shift_of(scene: SceneBatch, prompt: str, std: Tensor = STD, **settings: float) -> Tensor:
    """(N, 3) m that the first scene moves by at one step."""
    guidance = ClaimGuidance([prompt], scene.scene_type, settings.get("strength", 1.0))
    return guidance(0, 50, lambda: scene, std)[0]


def followed(scene: SceneBatch, prompt: str, steps: int = 16) -> SceneBatch:
    """The scene after ``steps`` moves, as if the prior expected it unchanged at each of them."""
    guidance = ClaimGuidance([prompt], scene.scene_type, 1.0)
    for step in range(steps):
        shift = guidance(step, steps, lambda: scene, STD)  # noqa: B023
        scene = scene.with_poses(scene.translations + shift, scene.rotations)
    return scene


def holds(scene: SceneBatch, prompt: str) -> bool:
    return parse_prompt(prompt, scene.scene_type).holds(scene_facts(scene)[0])


def slope(*numbers: float) -> float:
    return float(probability_slope(*torch.tensor(numbers, dtype=torch.float64)[:, None]))


# -- the moves --------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [-3.0, -0.2, 0.0, 0.4, 2.0, 9.0])
@pytest.mark.parametrize(("low", "high"), [(0.1, math.inf), (-0.3, 0.5), (-math.inf, 0.2), (0.0, 0.008)])
def test_the_mean_under_the_condition_is_that_of_a_truncated_normal(value: float, low: float, high: float) -> None:
    spread = 0.7
    mean = truncnorm.mean((low - value) / spread, (high - value) / spread, loc=value, scale=spread)
    assert value + spread**2 * slope(value, low, high, spread) == pytest.approx(mean, abs=1e-6)


def test_far_from_an_interval_the_slope_leads_to_its_nearest_end() -> None:
    assert -50 + slope(-50.0, 0.0, 0.5, 1.0) == pytest.approx(0.02, abs=1e-3)  # Mills: 1 / 50 beyond
    assert 1e4 + slope(1e4, 0.0, 0.008, 1.0) == pytest.approx(0.008, abs=1e-3)


def test_two_things_share_a_move_and_one_that_is_fixed_leaves_it_to_the_other() -> None:
    pair = build("dimsum_table", [("teapot", (0.0, 0.2, 0.0)), ("teacup", (0.0, -0.2, 0.0))])
    prompt = "A scene where the teapot is to the left of the cup."
    moved = shift_of(pair, prompt)
    torch.testing.assert_close(moved[1], -moved[2])
    assert float(moved[1, 1]) < -0.1  # left is -y
    kept = ClaimGuidance([prompt], "dimsum_table", 1.0, torch.arange(34)[None] != 2)(0, 50, lambda: pair, STD)
    assert float(kept[0, 1, 1]) < 1.9 * float(moved[1, 1])
    assert not kept[0, 2].any()
    torch.testing.assert_close(shift_of(pair, prompt, strength=2.0), 2 * moved)


def test_nothing_moves_at_low_noise_without_claims_or_where_they_are_out_of_doubt() -> None:
    pair = build("dimsum_table", [("teapot", (0.0, -0.3, 0.0)), ("teacup", (0.0, 0.3, 0.0))])
    prompt = "A scene where the teapot is to the left of the cup."
    guidance = ClaimGuidance([prompt], "dimsum_table", 2.0)
    assert [guidance.acts(torch.tensor(std)) for std in ([0.01] * 3, [0.03] * 3, [0.01, 0.01, 0.1])] == [
        False,
        True,
        False,
    ]
    assert float(shift_of(pair, prompt).abs().max()) < 1e-6
    for text in ("", "A scene with 3 objects.", "no such phrase", "A scene where the lid is on the moon."):
        assert not shift_of(pair, text).any()
    assert not shift_of(SceneBatch.empty("dimsum_table", 1), prompt).any()


# -- scenes that come to hold their claims ----------------------------------------------------------


@pytest.mark.parametrize(
    "claim",
    [
        "the teapot is to the left of the first cup from the left",
        "the teapot is to the right of the second cup from the left",
        "the teapot is in front of the first cup from the back",
        "the teapot is behind the second cup from the right",
        "the teapot is next to the first cup from the left",
        "the first cup from the left is behind the first cup from the front",  # both mean the same cup at first
    ],
)
def test_sides(claim: str) -> None:
    scene = build(
        "dimsum_table", [("teapot", (0.05, 0.0, 0.0)), ("teacup", (0.06, -0.2, 0.0)), ("teacup", (-0.1, 0.25, 0.0))]
    )
    prompt = f"A scene where {claim}."
    assert not holds(scene, prompt)
    assert holds(followed(scene, prompt), prompt)


@pytest.mark.parametrize(("place", "found"), [("top", False), ("bottom", True)])
@pytest.mark.parametrize("number", [1, 2, 3])
def test_things_on_a_tier(place: str, found: bool, number: int) -> None:
    cans = [("soda_can", (0.0, 0.1 * i - 0.1, BOTTOM)) for i in range(3)]
    scene = build("living_room_shelf", [*cans, ("book", (0.0, 0.25, TOP))])
    words = {1: "a coke can is", 2: "two coke cans are", 3: "three coke cans are"}
    prompt = f"A scene where {words[number]} on the {place} shelf."
    assert holds(scene, prompt) == (found and number == 3)
    assert holds(followed(scene, prompt), prompt)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
@pytest.mark.parametrize("on", [0, 1, 2, 3])
def test_things_on_other_things(on: int, number: int) -> None:
    bottoms = [("steamer_bottom", (0.0, 0.4 * i - 0.4, 0.0)) for i in range(3)]
    lids = [("steamer_lid", (0.0, 0.4 * i - 0.4, 0.091) if i < on else (0.35, 0.4 * i - 0.4, 0.0)) for i in range(3)]
    scene = build("dimsum_table", [*bottoms, *lids])
    prompt = {
        0: "A scene where no steamer lids are each on top of a steamer bottom.",
        1: "A scene where a steamer lid is on top of a steamer bottom.",
        2: "A scene where two steamer lids are each on top of a steamer bottom.",
        3: "A scene where three steamer lids are each on top of a steamer bottom.",
    }[number]
    assert holds(scene, prompt) == (on == number)
    assert holds(followed(scene, prompt), prompt)


@pytest.mark.parametrize("number", [1, 2])
def test_a_stack_of_things_of_one_name(number: int) -> None:
    scene = build("dimsum_table", [("steamer_bottom", (0.0, 0.3 * i - 0.3, 0.0)) for i in range(3)])
    words = {1: "a steamer bottom is", 2: "two steamer bottoms are each"}
    prompt = f"A scene where {words[number]} on top of a steamer bottom."
    assert not holds(scene, prompt)
    assert holds(followed(scene, prompt), prompt)


@pytest.mark.parametrize("claim", ["two coke cans are on top of the plate", "an apple is in the bowl"])
def test_things_on_or_in_one_certain_thing(claim: str) -> None:
    cans = [("soda_can", (0.1, 0.2 * i - 0.2, BOTTOM)) for i in range(2)]
    things = [
        ("shared_plate", (-0.02, 0.18, BOTTOM)),
        ("fruit_bowl", (0.0, -0.15, TOP)),
        ("apple_gala", (0.0, 0.1, TOP)),
    ]
    scene = build("living_room_shelf", [*cans, *things])
    prompt = f"A scene where {claim}."
    assert not holds(scene, prompt)
    assert holds(followed(scene, prompt), prompt)


@pytest.mark.parametrize("landmark", ["speaker", "book"])
def test_two_things_on_different_tiers_come_together(landmark: str) -> None:
    things = [("soda_can", (0.0, -0.2, BOTTOM)), ("book", (0.0, 0.0, BOTTOM)), ("speaker", (0.0, 0.2, TOP))]
    scene = build("living_room_shelf", things)
    prompt = f"A scene where the coke can is to the right of the {landmark}."
    assert not holds(scene, prompt)
    assert holds(followed(scene, prompt), prompt)


def test_the_thing_that_a_claim_places_stays_and_the_other_comes() -> None:
    things = [("soda_can", (0.0, 0.2, BOTTOM)), ("book", (0.0, -0.2, TOP))]
    prompt = "A scene where the coke can is to the right of the book and a coke can is on the bottom shelf."
    scene = build("living_room_shelf", things)
    assert not holds(scene, prompt)
    after = followed(scene, prompt)
    assert holds(after, prompt)
    assert float(after.translations[0, 2, 2]) < BOTTOM + 0.1


@pytest.mark.parametrize("number", [1, 2])
def test_things_that_are_too_many_on_a_table_go_to_another_table(number: int) -> None:
    tables = [("cafe_table", (0.0, -1.0, 0.0)), ("cafe_table", (0.0, 1.0, 0.0))]
    plates = [("dinner_plate", (0.0, -1.0 + 0.25 * (i - 1), 0.0)) for i in range(3)]
    scene = build("restaurant_low_clutter", [*tables, *plates])
    words = {1: "a plate is", 2: "two plates are"}
    prompt = f"A scene where {words[number]} on the first table from the left."
    assert holds(scene, "A scene where three plates are on the first table from the left.")
    assert holds(followed(scene, prompt), prompt)


def test_what_a_thing_carries_goes_with_it() -> None:
    scene = build(
        "dimsum_table",
        [("dinner_plate", (0.0, 0.2, 0.0)), ("teacup", (0.0, 0.2, 0.008)), ("teapot", (0.0, -0.2, 0.0))],
    )
    assert holds(scene, "A scene where a cup is on top of the plate.")
    moved = shift_of(scene, "A scene where the plate is to the left of the teapot.")
    torch.testing.assert_close(moved[2], moved[1])
    assert float(moved[1, 1]) < -0.05


def test_each_scene_of_a_batch_moves_as_it_does_alone() -> None:
    """Scenes of three prompts each, with supports, places, sides and orders, and one that cannot be read."""
    rng = np.random.default_rng(3)
    scenes = get_grammar("living_room_shelf").sample(rng, 12)
    noise = torch.randn(scenes.translations.shape, generator=torch.Generator().manual_seed(0))
    scenes = scenes.with_poses(scenes.translations + 0.05 * noise, scenes.rotations)
    prompts = describe(get_grammar("living_room_shelf").sample(rng, 12), rng, kinds=["relations"])
    prompts[5] = "no such phrase"
    together = ClaimGuidance(prompts, "living_room_shelf", 2.0)(0, 50, lambda: scenes, STD)
    for row, prompt in enumerate(prompts):
        alone = ClaimGuidance([prompt], "living_room_shelf", 2.0)(0, 50, lambda: scenes[row : row + 1], STD)  # noqa: B023
        torch.testing.assert_close(together[row], alone[0], rtol=0, atol=1e-9)
    assert not together[5].any()
    assert int(together.flatten(1).any(dim=1).sum()) > 3


# -- priors -----------------------------------------------------------------------------------------


def test_relations_are_followed_by_samples() -> None:
    prior = ScenePrior.load("dimsum_table")
    rng = np.random.default_rng(0)
    prompts = describe(get_grammar("dimsum_table").sample(rng, 16), rng, kinds=["relations"])

    def share(strength: float) -> float:
        batch = prior.sample(16, prompt=prompts, claim_guidance=strength, num_steps=12, seed=0)
        checks = [parse_prompt(p, "dimsum_table").check(s) for p, s in zip(prompts, scene_facts(batch), strict=True)]
        return float(np.mean([check.holds for claims in checks for check in claims]))

    assert share(2.0) > share(0.0) + 0.1


def test_guidance_of_zero_changes_no_bit_and_kept_entries_stay() -> None:
    prior = tiny_prior(process="mixed", text=True)
    prompt = "A scene where the teapot is to the left of the cup."
    plain = prior.sample(3, prompt=prompt, num_steps=3)
    assert torch.equal(plain.tensor, prior.sample(3, prompt=prompt, claim_guidance=0.0, num_steps=3).tensor)
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    prompts = describe(scenes, np.random.default_rng(1), kinds=["relations"])
    full = prior.complete(scenes, prompt=prompts, claim_guidance=2.0, num_steps=4)
    assert torch.equal(full.tensor[~scenes.is_empty], scenes.tensor[~scenes.is_empty])
    moved = prior.rearrange(scenes, prompt=prompts, claim_guidance=2.0, num_steps=4)
    assert torch.equal(moved.categories, scenes.categories)
    assert torch.equal(moved.tensor[:, 0], scenes.tensor[:, 0])
    assert not torch.equal(moved.tensor, prior.rearrange(scenes, prompt=prompts, num_steps=4).tensor)


@pytest.mark.parametrize("strength", [-1.0, math.nan, math.inf])
def test_a_strength_below_zero_or_not_finite_is_refused(strength: float) -> None:
    with pytest.raises(InvalidInputError, match=r"claim_guidance=.*of at least 0"):
        tiny_prior(process="mixed", text=True).sample(1, prompt="A scene.", claim_guidance=strength, num_steps=2)


@pytest.mark.parametrize("prompt", [None, ""])
def test_a_strength_without_a_prompt_is_refused(prompt: str | None) -> None:
    with pytest.raises(InvalidInputError, match=r"claim_guidance=2 .* give prompt="):
        tiny_prior(process="mixed", text=True).sample(1, prompt=prompt, claim_guidance=2.0, num_steps=2)
