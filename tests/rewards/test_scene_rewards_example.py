"""The rewards of ``examples/scene_rewards.py``: the prior's own training loss, and distances with closed forms."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
import torch

from agents.priors.testing import tiny_prior
from rewards import RewardContext, check_reward, evaluate_reward
from scene_envs import SceneBatch, get_grammar
from scene_envs.errors import RewardError
from tests.helpers.examples import load_example


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("scene_rewards")


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_realism_is_minus_the_training_loss_at_fixed_noise(
    example: ModuleType, process: str, scenes: SceneBatch
) -> None:
    prior = tiny_prior(process=process)
    value = example.Realism(prior=prior, levels=3, seed=5)(scenes[0], RewardContext()).value
    present = [slot for slot in range(34) if not bool(scenes.is_empty[0, slot])]
    rows = scenes.tensor[0, :, :12]
    key = lambda slot: (int(scenes.categories[0, slot]), *rows[slot].tolist())  # noqa: E731
    order = [0, *sorted(present[1:], key=key)]
    x0 = prior.encode(SceneBatch(scenes.tensor[:1, order], scenes.scene_type).with_slots(34)).expand(3, -1, -1)
    with torch.no_grad():
        loss = prior.pretraining_loss(x0, torch.Generator().manual_seed(5), "none", prior.step_table(3).timesteps)
    assert value.item() == pytest.approx(-float(loss.mean()), rel=1e-6)


def test_real_scenes_are_likelier_than_the_same_objects_strewn_about(example: ModuleType, scenes: SceneBatch) -> None:
    noise = 0.1 * torch.randn(scenes.translations.shape, generator=torch.Generator().manual_seed(0))
    strewn = scenes.with_poses(scenes.translations + noise * scenes.is_free[..., None], scenes.rotations)
    reward = example.Realism(levels=4)
    real, moved = (evaluate_reward(reward, batch, strict=True).value for batch in (scenes, strewn))
    assert bool((real > moved).all())


def test_scenes_without_their_fixed_objects_are_invalid(example: ModuleType, scenes: SceneBatch) -> None:
    categories = scenes.categories.clone()
    categories[1, 0] = scenes.scene_type.num_assets
    bare = SceneBatch.from_parts(scenes.translations, scenes.rotations, categories, scenes.scene_type)
    reward = example.Realism(prior=tiny_prior(), levels=1)
    assert evaluate_reward(reward, bare).is_valid.tolist() == [True, False, True]


def test_what_is_no_prior_of_these_scenes_is_refused(example: ModuleType, scenes: SceneBatch) -> None:
    shelf = tiny_prior("pantry_shelf")
    for prior, message in ((shelf, "of scene type 'pantry_shelf', the scenes"), (3, "realism: 3 is not a ScenePrior")):
        with pytest.raises(RewardError, match=message):
            evaluate_reward(example.Realism(prior=prior), scenes, strict=True)


def test_diversity_is_the_mean_distance_to_the_others(example: ModuleType) -> None:
    """Cups 10 cm apart cost 0.1 m of at most 0.245 m; a pot has nothing in common with a cup."""
    batch = SceneBatch.empty("dimsum_table", 3, slots=8)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    categories[:, 1] = torch.tensor([batch.scene_type.assets.index(name) for name in ("teacup", "teacup", "teapot")])
    translations[1, 1, 0] = 0.1
    rotations = torch.eye(3).expand(3, 8, 3, 3)
    batch = SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)
    output = evaluate_reward(example.Diversity(), batch, strict=True)
    near = 0.1 / 0.245
    assert output.value.tolist() == pytest.approx([(near + 1) / 2, (near + 1) / 2, 1.0])
    assert output.terms["nearest"].tolist() == pytest.approx([near, near, 1.0])
    assert evaluate_reward(example.Diversity(), batch[0], strict=True).is_valid.tolist() == [False]


def test_both_keep_the_contract(example: ModuleType) -> None:
    assert len(check_reward(example.Realism(prior=tiny_prior(process="mixed"), levels=2))) == 6
    assert "scores a scene the same alone and in a batch" not in check_reward(example.Diversity(), "living_room_shelf")
