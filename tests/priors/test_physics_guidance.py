"""Physics guidance: when it moves objects, what samples gain, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from agents import ScenePrior
from agents.prior_names import list_priors
from agents.priors.card import package_prior
from agents.priors.files import read_config
from agents.priors.physics_guidance import PhysicsGuidance
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.physics import feasibility
from scene_envs.physics.correction import corrections
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE
from tests.helpers.simple_scenes import scene as boxes

STD = torch.tensor([0.01, 0.01, 0.001])


@pytest.fixture(scope="module")
def overlapping() -> SceneBatch:
    return boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.01, 0.03, 0.0))


def test_moves_are_the_corrections_times_the_strength(overlapping: SceneBatch) -> None:
    moves = corrections(overlapping, STD.double().numpy())
    for strength in (1.0, 0.5):
        shift = PhysicsGuidance(strength)(40, 50, lambda: overlapping, STD)
        assert shift is not None
        torch.testing.assert_close(shift, strength * moves)
    assert moves.abs().max() > 0.004


def test_nothing_moves_while_positions_are_uncertain(overlapping: SceneBatch) -> None:
    assert PhysicsGuidance(1.0)(0, 50, lambda: overlapping, torch.tensor([0.01, 0.04, 0.001])) is None
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
        batch = prior.sample(12, num_steps=25, seed=2, physics_guidance=strength)
        share.append(float(feasibility(batch).feasible[batch.is_free].double().mean()))
    assert share[1] > share[0] + 0.05, share
    assert share[1] > 0.85, share


def test_without_guidance_no_bit_changes_and_with_it_welded_objects_stay() -> None:
    prior = ScenePrior.load("living_room_shelf")
    plain, none, guided = (
        prior.sample(4, num_steps=10, **how) for how in ({}, {"physics_guidance": 0.0}, {"physics_guidance": 1.0})
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
    scenes = prior.sample(3, num_steps=10, seed=5)
    completed = prior.complete(scenes, fill=4, num_steps=10, physics_guidance=1.0)
    kept = ~scenes.is_empty
    assert torch.equal(completed.tensor[kept], scenes.tensor[kept])
    moved = prior.rearrange(scenes, num_steps=10, physics_guidance=1.0)
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
