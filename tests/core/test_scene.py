"""The scene tensor: layout, decoding, normalisation, files; scene types and their facts."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from scene_envs import get_grammar
from scene_envs.assets import ASSET_GROUPS, list_assets, register_asset_group
from scene_envs.datasets import scene_facts
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, list_scene_types


@pytest.fixture
def batch() -> SceneBatch:
    """Two scenes: table, steamer with lid; and table, teapot."""
    generator = torch.Generator().manual_seed(0)
    scene_type = get_scene_type("dimsum_table")
    categories = torch.full((2, 34), scene_type.num_assets)
    for scene, names in enumerate((("cafe_table", "steamer_bottom", "steamer_lid"), ("cafe_table", "teapot"))):
        for slot, name in enumerate(names):
            categories[scene, slot] = scene_type.assets.index(name)
    rotations = torch.from_numpy(Rotation.random(68, random_state=1).as_matrix()).float().reshape(2, 34, 3, 3)
    return SceneBatch.from_parts(torch.rand(2, 34, 3, generator=generator) * 0.4, rotations, categories, scene_type)


def test_layout_is_translation_rotation_one_hot_with_empty_last(batch: SceneBatch) -> None:
    assert batch.tensor.shape == (2, 34, 3 + 9 + 7 + 1)
    assert batch.counts.tolist() == [3, 2]
    assert batch.names() == [["cafe_table", "steamer_bottom", "steamer_lid"], ["cafe_table", "teapot"]]
    empty = batch.tensor[batch.is_empty]
    assert bool((empty[:, :-1] == 0).all())
    assert bool((empty[:, -1] == 1).all())
    assert batch.is_welded.sum().item() == 2
    assert batch.is_free.sum().item() == 3


def test_noisy_tensors_decode_to_rotations_and_arg_max(batch: SceneBatch) -> None:
    noisy = batch.tensor + 0.05 * torch.randn(batch.tensor.shape, generator=torch.Generator().manual_seed(1))
    decoded = SceneBatch.from_tensor(noisy, batch.scene_type)
    assert torch.equal(decoded.categories, batch.categories)
    rotations = decoded.rotations[~decoded.is_empty]
    identity = torch.eye(3).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.mT, identity, atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(len(rotations)))


def test_normalising_round_trips(batch: SceneBatch) -> None:
    normalizer = Normalizer.fit(batch.tensor)
    normalised = batch.to_tensor(normalised=normalizer)
    assert float(normalised.min()) >= -1 - 1e-5
    assert float(normalised.max()) <= 1 + 1e-5
    back = SceneBatch.from_tensor(normalised, batch.scene_type, normalised=normalizer)
    torch.testing.assert_close(back.tensor, batch.tensor, atol=1e-5, rtol=0)
    again = Normalizer.from_state(normalizer.state())
    assert torch.equal(again.normalize(batch.tensor), normalised)


def test_files_round_trip_and_corrupt_ones_are_named(batch: SceneBatch, tmp_path: Path) -> None:
    path = batch.save(tmp_path / "scenes.safetensors")
    assert torch.equal(SceneBatch.load(path).tensor, batch.tensor)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(CorruptFileError, match=r"scenes\.safetensors"):
        SceneBatch.load(path)
    with pytest.raises(InvalidInputError, match="no scene file"):
        SceneBatch.load(tmp_path / "nothing.safetensors")


def test_bad_tensors_name_the_place(batch: SceneBatch) -> None:
    broken = batch.tensor.clone()
    broken[1, 7, 2] = float("nan")
    with pytest.raises(InvalidInputError, match="scene 1, slot 7, feature 2"):
        SceneBatch(broken, batch.scene_type)
    with pytest.raises(InvalidInputError, match=r"\(B, N, 20\)"):
        SceneBatch(batch.tensor[..., :-1], batch.scene_type)
    with pytest.raises(InvalidInputError, match=r"0\.\.7"):
        SceneBatch.from_parts(batch.translations, batch.rotations, batch.categories + 3, batch.scene_type)


def test_slots_are_added_and_dropped_only_when_empty(batch: SceneBatch) -> None:
    assert torch.equal(batch.with_slots(40).with_slots(34).tensor, batch.tensor)
    assert batch.with_slots(40).counts.tolist() == batch.counts.tolist()
    with pytest.raises(InvalidInputError, match=r"slots=2: .* slots hold them"):
        batch.with_slots(2)


def test_unknown_scene_types_offer_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        get_scene_type("dimsum")
    assert "dimsum_table" in list_scene_types()


def test_a_scene_type_that_is_no_name_is_refused(batch: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="a scene type or its name is needed, got a Tensor"):
        SceneBatch("dimsum_table", batch.tensor)  # type: ignore[arg-type]


def test_scenes_pickle(batch: SceneBatch) -> None:
    assert torch.equal(pickle.loads(pickle.dumps(batch)).tensor, batch.tensor)


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
