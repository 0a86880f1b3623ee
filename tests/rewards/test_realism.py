"""The reward of likelihood under a frozen prior, against the prior's own training loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from agents.priors.testing import tiny_prior
from rewards import Realism, RewardContext, check_reward, evaluate_reward
from scene_envs import SceneBatch, get_grammar
from scene_envs.errors import RewardError


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_it_is_minus_the_training_loss_at_fixed_noise(process: str, scenes: SceneBatch) -> None:
    prior = tiny_prior(process=process)
    value = Realism(prior=prior, levels=3, seed=5)(scenes[0], RewardContext()).value
    present = [slot for slot in range(34) if not bool(scenes.is_empty[0, slot])]
    rows = scenes.tensor[0, :, :12]
    key = lambda slot: (int(scenes.categories[0, slot]), *rows[slot].tolist())  # noqa: E731
    order = [0, *sorted(present[1:], key=key)]
    x0 = prior.encode(SceneBatch(scenes.tensor[:1, order], scenes.scene_type).with_slots(34)).expand(3, -1, -1)
    with torch.no_grad():
        loss = prior.pretraining_loss(x0, torch.Generator().manual_seed(5), "none", prior.step_table(3).timesteps)
    assert value.item() == pytest.approx(-float(loss.mean()), rel=1e-6)


def test_real_scenes_are_likelier_than_the_same_objects_strewn_about(scenes: SceneBatch) -> None:
    noise = 0.1 * torch.randn(scenes.translations.shape, generator=torch.Generator().manual_seed(0))
    strewn = scenes.with_poses(scenes.translations + noise * scenes.is_free[..., None], scenes.rotations)
    reward = Realism(levels=4)
    real, moved = (evaluate_reward(reward, batch, strict=True).value for batch in (scenes, strewn))
    assert bool((real > moved).all())


def test_scenes_without_their_fixed_objects_are_invalid(scenes: SceneBatch) -> None:
    categories = scenes.categories.clone()
    categories[1, 0] = scenes.scene_type.num_assets
    bare = SceneBatch.from_parts(scenes.translations, scenes.rotations, categories, scenes.scene_type)
    assert evaluate_reward(Realism(prior=tiny_prior(), levels=1), bare).is_valid.tolist() == [True, False, True]


def test_what_is_no_prior_of_these_scenes_is_refused(scenes: SceneBatch) -> None:
    with pytest.raises(RewardError, match="of scene type 'pantry_shelf', the scenes are of 'dimsum_table'"):
        evaluate_reward(Realism(prior=tiny_prior("pantry_shelf")), scenes, strict=True)
    with pytest.raises(RewardError, match="unknown prior 'dimsum_tabel'"):
        evaluate_reward(Realism(prior="dimsum_tabel"), scenes, strict=True)
    with pytest.raises(RewardError, match=r"has no encode\(\) and pretraining_loss\(\)"):
        evaluate_reward(Realism(prior=3), scenes, strict=True)


def test_it_keeps_the_contract() -> None:
    assert len(check_reward(Realism(prior=tiny_prior(process="mixed"), levels=2))) == 6
