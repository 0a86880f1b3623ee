"""The scene tensor: layout, decoding, normalisation, files."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from scipy.spatial.transform import Rotation

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
