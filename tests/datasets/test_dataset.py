"""Datasets in memory and on disk, read by us and by Hugging Face ``datasets``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from scene_envs.datasets import SceneDataset, describe_all, read_metadata
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.normalizer import Normalizer
from tests.helpers.toy_grammars import TYPE, toy_scenes


@pytest.fixture(scope="module")
def dataset() -> SceneDataset:
    batch = toy_scenes(40)
    low, high = torch.tensor([-0.4, -0.4, 0.0] + [-1.0] * 9 + [0.0] * 4), torch.tensor([0.4, 0.4, 0.5] + [1.0] * 13)
    for constant in (5, 8, 9, 10):
        low[constant] = high[constant] = 0.0
    low[11] = 0.0
    sets = describe_all(batch, np.random.default_rng(0))
    return SceneDataset.from_sets(batch.tensor, sets, Normalizer.from_range(low, high), TYPE)


@pytest.fixture
def folder(dataset: SceneDataset, tmp_path: Path) -> Path:
    return dataset.save(tmp_path / "scenes", shard_size=25)


def test_save_and_load_give_the_same_scenes(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder)
    assert loaded.prompts == dataset.prompts
    assert loaded.prompt_sets == dataset.prompt_sets
    assert loaded.scene_type is dataset.scene_type
    torch.testing.assert_close(loaded.tensor, dataset.tensor, atol=1e-7, rtol=0)
    constant = [5, 8, 9, 10, 11, *range(12, 16)]
    assert torch.equal(loaded.tensor[..., constant], dataset.tensor[..., constant])
    on_table = dataset.tensor[..., 2] == 0
    assert (loaded.tensor[..., 2][on_table] == 0).all()


def test_hugging_face_datasets_reads_the_shards(dataset: SceneDataset, folder: Path, tmp_path: Path) -> None:
    import datasets

    files = sorted(map(str, folder.glob("*.parquet")))
    loaded = datasets.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path / "cache"))["train"]
    assert loaded.column_names == ["scenes", "language_annotation", "language_annotations"]
    assert loaded["language_annotation"][:] == dataset.prompts
    assert [tuple(prompts) for prompts in loaded["language_annotations"][:]] == dataset.prompt_sets
    scenes = torch.tensor(loaded[:]["scenes"])
    assert scenes.shape == (40, 5, 16)
    torch.testing.assert_close(scenes, dataset.normalizer.normalize(dataset.tensor))


def test_limit_reads_a_prefix(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder, limit=10)
    assert len(loaded) == 10
    assert loaded.prompts == dataset.prompts[:10]
    assert not loaded.complete


def test_a_dataset_with_one_prompt_per_scene_has_the_published_columns(dataset: SceneDataset, tmp_path: Path) -> None:
    one = SceneDataset(dataset.tensor, dataset.prompts, dataset.normalizer, TYPE)
    assert one.prompt_sets == [(prompt,) for prompt in dataset.prompts]
    file = one.save(tmp_path) / "scenes-00000.parquet"
    assert pq.read_schema(file).names == ["scenes", "language_annotation"]
    assert SceneDataset.load(tmp_path).prompt_sets == one.prompt_sets


def test_prompt_sets_that_contradict_the_prompts_are_refused(dataset: SceneDataset) -> None:
    sets = [("Something else.",)] * 40
    with pytest.raises(InvalidInputError, match="prompt_sets"):
        SceneDataset(dataset.tensor, dataset.prompts, dataset.normalizer, TYPE, {}, sets)


def test_metadata_alone_tells_what_a_dataset_holds(folder: Path, dataset: SceneDataset) -> None:
    for file in folder.glob("*.parquet"):
        file.unlink()
    info = read_metadata(folder)
    assert info.stems == ("cafe_table", "dinner_plate", "teacup")
    assert info.welded_model_paths == ("scene_envs/assets/cafe_table",)
    assert (info.slots, info.features, info.scene_type, info.count) == (5, 16, "toy_cups", 40)
    assert torch.equal(info.normalizer.scale, dataset.normalizer.scale)
    assert info.categories_in(TYPE).tolist() == [0, 1, 2, 3]


def test_split_is_disjoint_seeded_and_covers_all(dataset: SceneDataset) -> None:
    parts = dataset.split((0.5, 0.25, 0.25), seed=1)
    assert [len(part) for part in parts] == [20, 10, 10]
    rows = torch.cat([part.tensor for part in parts]).flatten(1)
    assert len(torch.unique(rows, dim=0)) == 40
    again = dataset.split((0.5, 0.25, 0.25), seed=1)
    assert torch.equal(parts[0].tensor, again[0].tensor)
    assert parts[0].prompts == again[0].prompts
    assert not torch.equal(parts[0].tensor, dataset.split((0.5,), seed=2)[0].tensor)


@pytest.mark.parametrize("fractions", [(0.8, 0.3), (-0.1, 0.5)])
def test_impossible_fractions_are_refused(dataset: SceneDataset, fractions: tuple[float, ...]) -> None:
    with pytest.raises(InvalidInputError, match="fractions"):
        dataset.split(fractions)


def test_missing_folder_and_missing_metadata_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="nowhere"):
        SceneDataset.load(tmp_path / "nowhere")
    (folder / "metadata.json").unlink()
    with pytest.raises(InvalidInputError, match=r"metadata\.json"):
        SceneDataset.load(folder)


def test_a_truncated_parquet_file_is_named(folder: Path) -> None:
    path = folder / "scenes-00001.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CorruptFileError, match="scenes-00001"):
        SceneDataset.load(folder)


def test_a_dataset_that_lost_scenes_says_so(
    dataset: SceneDataset, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    SceneDataset.load(folder)
    assert not caplog.text
    shard = sorted(folder.glob("*.parquet"))[-1]
    pq.write_table(pq.read_table(shard).slice(1), shard)
    assert len(SceneDataset.load(folder, limit=1)) == 1
    assert not caplog.text
    assert not SceneDataset.load(folder).complete
    assert f"holds {len(dataset) - 1} of the {len(dataset)} requested scenes" in caplog.text


def test_a_missing_column_is_named(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["language_annotation"]), path)
    with pytest.raises(CorruptFileError, match="language_annotation"):
        SceneDataset.load(folder)


def test_scenes_of_the_wrong_width_are_refused(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pa.table({"scenes": [[[0.0] * 15] * 5], "language_annotation": ["A scene."]}), path)
    with pytest.raises(CorruptFileError, match="expected 16 features"):
        SceneDataset.load(folder)


@pytest.mark.parametrize("content", ["{not json", '{"model_paths": []}', "[]"])
def test_broken_metadata_is_named(folder: Path, content: str) -> None:
    (folder / "metadata.json").write_text(content)
    with pytest.raises(CorruptFileError, match=r"metadata\.json"):
        SceneDataset.load(folder)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("translation_vec_len", 7, "translation_vec_len is 7, expected 3"),
        ("model_path_vec_len", 3, "model_path_vec_len is 3, expected 4"),
        ("model_paths", ["a/cafe_table"], "model_path_vec_len is 4, expected 2"),
        ("normalizer_state", {"params": {}}, "normalizer_state lacks"),
    ],
)
def test_contradicting_metadata_is_named(folder: Path, key: str, value: object, words: str) -> None:
    path = folder / "metadata.json"
    content = json.loads(path.read_text()) | {key: value}
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFileError, match=r"metadata\.json.* was changed after it was written .*remove its key"):
        read_metadata(folder)
    path.write_text(json.dumps({name: entry for name, entry in content.items() if name != "sha256"}))
    with pytest.raises(CorruptFileError, match=words):
        read_metadata(folder)


def test_saving_into_a_used_folder_is_refused(dataset: SceneDataset, folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="already holds"):
        dataset.save(folder)
