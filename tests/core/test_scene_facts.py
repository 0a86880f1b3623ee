"""Sizes, masses, supports and groups of the assets in scenes, against trimesh and the facts that prompts state."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from scene_envs import SceneBatch, get_grammar, get_scene_type
from scene_envs.assets import ASSET_GROUPS, list_assets, register_asset_group
from scene_envs.datasets import scene_facts
from scene_envs.errors import InvalidInputError, UnknownNameError


@pytest.fixture(scope="module")
def tilted() -> SceneBatch:
    """One scene of every breakfast asset at a random pose."""
    kind = get_scene_type("breakfast_table_low_clutter")
    count = kind.num_assets
    rotations = torch.from_numpy(Rotation.random(count, random_state=0).as_matrix()).float()
    translations = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    batch = SceneBatch.from_parts(translations[None], rotations[None], torch.arange(count)[None], kind)
    return batch.with_slots(count + 1)


def test_boxes_volumes_and_masses_are_those_of_trimesh(tilted: SceneBatch) -> None:
    boxes, volumes = tilted.bounding_boxes, tilted.volumes
    for slot, asset in enumerate(tilted.scene_type.library):
        parts = [trimesh.convex.convex_hull(part.vertices) for part in asset.fine]
        assert float(volumes[0, slot]) == pytest.approx(sum(part.volume for part in parts), rel=1e-5)
        assert float(tilted.masses[0, slot]) == pytest.approx(asset.mass)
        mesh = trimesh.util.concatenate(parts)
        np.testing.assert_allclose(tilted.sizes[0, slot], mesh.extents, atol=1e-6)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = tilted.rotations[0, slot], tilted.translations[0, slot]
        mesh.apply_transform(pose)
        np.testing.assert_allclose(boxes[0, slot], mesh.bounds, atol=1e-5)


def test_empty_slots_have_no_size(tilted: SceneBatch) -> None:
    for facts in (tilted.bounding_boxes, tilted.sizes, tilted.masses, tilted.volumes):
        assert float(facts[0, -1].abs().sum()) == 0.0
    assert tilted.supports[0, -1].item() == -1


@pytest.mark.parametrize("scene_type", ["dimsum_table", "living_room_shelf"])
def test_supports_are_those_that_prompts_speak_of(scene_type: str) -> None:
    batch = get_grammar(scene_type).sample(np.random.default_rng(0), 3)
    supports = batch.supports
    for row, facts in enumerate(scene_facts(batch)):
        expected = np.where(facts.held.support >= 0, facts.slots[facts.held.support], -1)
        assert supports[row, facts.slots].tolist() == expected.tolist()
    assert bool((supports[batch.is_free] >= 0).all())
    assert bool((supports[~batch.is_free] == -1).all())


def test_a_stack_is_a_chain_of_supports() -> None:
    batch = SceneBatch.empty("dimsum_table", 1, slots=4)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    height = batch.scene_type.library["steamer_bottom"].bounds[1, 2]
    for slot in (1, 2):
        categories[0, slot] = batch.scene_type.assets.index("steamer_bottom")
        translations[0, slot, 2] = (slot - 1) * height
    stack = SceneBatch.from_parts(translations, torch.eye(3).expand(1, 4, 3, 3), categories, batch.scene_type)
    assert stack.supports.tolist() == [[-1, 0, 1, -1]]


def test_assets_are_found_by_name_display_name_and_group(tilted: SceneBatch) -> None:
    names = np.array(tilted.scene_type.assets)
    assert names[tilted.is_any_of("plate")[0, :-1]].tolist() == [
        "plate",
        "shared_plate",
    ]  # the name of one, said of both
    assert names[tilted.is_any_of("spoon", "mug")[0, :-1]].tolist() == ["dinner_spoon", "mug", "teaspoon"]
    assert names[tilted.is_any_of("edible")[0, :-1]].tolist() == [
        "apple_gala",
        "bread_slice",
        "cereal_box",
        "pear_bosc",
    ]
    assert not bool(tilted.is_any_of("toys").any())
    with pytest.raises(UnknownNameError, match="'edibel'; did you mean 'edible'"):
        tilted.is_any_of("edibel")


def test_groups_name_built_in_assets_and_users_add_their_own(
    tilted: SceneBatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set().union(*ASSET_GROUPS.values()) <= set(list_assets())
    monkeypatch.setattr("scene_envs.assets.base.ASSET_GROUPS", dict(ASSET_GROUPS))
    register_asset_group("breakable", ["bowl", "mug"])
    assert int(tilted.is_any_of("breakable").sum()) == 2
    with pytest.raises(InvalidInputError, match="the string 'bowl'"):
        register_asset_group("breakable", "bowl")
