"""The reward for objects that a gripper can reach."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rewards import Reachability, RewardContext, check_reward
from scene_envs import SceneBatch, get_grammar
from scene_envs.errors import InvalidInputError, UnknownNameError


def cans(*places: tuple[float, float, float]) -> SceneBatch:
    """Coke cans (67 mm wide, 122 mm high) on tiers of a pantry shelf."""
    batch = SceneBatch.empty("pantry_shelf", 1, slots=8)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    for slot, place in enumerate(places, start=1):
        translations[0, slot], categories[0, slot] = torch.tensor(place), batch.scene_type.assets.index("soda_can")
    return SceneBatch.from_parts(translations, torch.eye(3).expand(1, 8, 3, 3), categories, batch.scene_type)


def test_a_can_behind_another_is_not_reached_from_the_front() -> None:
    """In the air, where the viewer is at +x: the first can hides the second, the third is beside them."""
    batch = cans((0.05, 0.0, 0.45), (-0.05, 0.0, 0.45), (0.0, 0.2, 0.45))
    front = Reachability("front")(batch, RewardContext())
    assert front.per_object[0, 1:4].tolist() == [1.0, 0.0, 1.0]
    assert front.value.item() == pytest.approx(2 / 3)
    both = Reachability()(batch, RewardContext())
    assert both.value.item() == 1.0
    assert both.terms["from_front"].item() == 2
    assert both.terms["from_above"].item() == 3


def test_what_is_outside_the_workspace_is_not_reached() -> None:
    assert Reachability()(cans((0.0, 0.5, 0.45)), RewardContext()).value.item() == 0.0


@pytest.mark.slow
def test_a_smaller_gripper_reaches_less() -> None:
    scenes = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 2)
    large, small = (Reachability(opening=width)(scenes, RewardContext()) for width in (0.1, 0.04))
    assert bool((large.value > small.value).all())
    assert torch.equal(large.object_flags["reachable"], large.per_object > 0)


@pytest.mark.slow
@pytest.mark.parametrize("scene_type", ["dimsum_table", "living_room_shelf"])
def test_it_keeps_the_contract(scene_type: str) -> None:
    assert len(check_reward("reachability", scene_type)) == 6


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="'abvoe'; did you mean 'above'"):
        Reachability("abvoe")
    with pytest.raises(InvalidInputError, match="sides is empty"):
        Reachability([])
    with pytest.raises(InvalidInputError, match="positive"):
        Reachability(opening=-1.0)
