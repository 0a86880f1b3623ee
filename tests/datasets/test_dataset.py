"""Datasets in memory and on disk, read by us and by Hugging Face ``datasets``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from scene_envs.datasets import SceneDataset, describe, fixed_normalizer
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar


@pytest.fixture(scope="module")
def dataset() -> SceneDataset:
    grammar, rng = get_grammar("dimsum_table"), np.random.default_rng(0)
    batch = grammar.sample(rng, 40)
    return SceneDataset(batch.tensor, describe(batch, rng), fixed_normalizer(grammar), batch.scene_type)


@pytest.fixture
def folder(dataset: SceneDataset, tmp_path: Path) -> Path:
    return dataset.save(tmp_path / "scenes", shard_size=25)


def test_save_and_load_give_the_same_scenes(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder)
    assert loaded.prompts == dataset.prompts
    assert loaded.scene_type is dataset.scene_type
    torch.testing.assert_close(loaded.tensor, dataset.tensor, atol=1e-7, rtol=0)
    constant = [5, 8, 9, 10, 11, *range(12, 20)]
    assert torch.equal(loaded.tensor[..., constant], dataset.tensor[..., constant])
    on_table = dataset.tensor[..., 2] == 0
    assert (loaded.tensor[..., 2][on_table] == 0).all()


def test_hugging_face_datasets_reads_the_shards(dataset: SceneDataset, folder: Path, tmp_path: Path) -> None:
    import datasets

    files = sorted(map(str, folder.glob("*.parquet")))
    loaded = datasets.load_dataset("parquet", data_files=files, cache_dir=str(tmp_path / "cache"))["train"]
    assert loaded.column_names == ["scenes", "language_annotation"]
    assert loaded["language_annotation"][:] == dataset.prompts
    scenes = torch.tensor(loaded[:]["scenes"])
    assert scenes.shape == (40, 34, 20)
    torch.testing.assert_close(scenes, dataset.normalizer.normalize(dataset.tensor))


def test_a_file_written_by_hugging_face_datasets_loads(dataset: SceneDataset, folder: Path, tmp_path: Path) -> None:
    import datasets

    features = datasets.Features(
        {"scenes": datasets.Array2D((34, 20), "float32"), "language_annotation": datasets.Value("string")}
    )
    scenes = dataset.normalizer.normalize(dataset.tensor).numpy()
    rows = {"scenes": list(scenes), "language_annotation": dataset.prompts}
    datasets.Dataset.from_dict(rows, features=features).to_parquet(tmp_path / "theirs.parquet")
    (tmp_path / "metadata.json").write_bytes((folder / "metadata.json").read_bytes())
    loaded = SceneDataset.load(tmp_path / "theirs.parquet")
    torch.testing.assert_close(loaded.tensor, dataset.tensor, atol=1e-7, rtol=0)


def test_categories_are_matched_by_path_not_by_index(dataset: SceneDataset, folder: Path) -> None:
    """A file whose assets come in reverse order, under other paths, holds the same scenes."""
    order = [*range(12), *range(18, 11, -1), 19]
    path = folder / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["model_paths"] = [f"package://other/{Path(p).name}.sdf" for p in reversed(metadata["model_paths"])]
    path.write_text(json.dumps(metadata))
    normalised = dataset.normalizer.normalize(dataset.tensor)[..., order].numpy()
    for file in folder.glob("*.parquet"):
        file.unlink()
    table = pa.table({"scenes": normalised.tolist(), "language_annotation": dataset.prompts})
    pq.write_table(table, folder / "a.parquet")
    torch.testing.assert_close(SceneDataset.load(folder).tensor, dataset.tensor, atol=1e-7, rtol=0)


def test_other_asset_names_need_aliases(dataset: SceneDataset, folder: Path) -> None:
    path = folder / "metadata.json"
    path.write_text(path.read_text().replace("assets/teacup", "assets/coffee_cup_white"))
    with pytest.raises(UnknownNameError, match="coffee_cup_white"):
        SceneDataset.load(folder)
    loaded = SceneDataset.load(folder, aliases={"coffee_cup_white": "teacup"})
    torch.testing.assert_close(loaded.tensor, dataset.tensor, atol=1e-7, rtol=0)


def test_limit_reads_a_prefix(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder, limit=10)
    assert len(loaded) == 10
    assert loaded.prompts == dataset.prompts[:10]
    assert not loaded.complete


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


def test_a_missing_column_is_named(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pq.read_table(path).drop_columns("language_annotation"), path)
    with pytest.raises(CorruptFileError, match="language_annotation"):
        SceneDataset.load(folder)


def test_scenes_of_the_wrong_width_are_refused(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pa.table({"scenes": [[[0.0] * 19] * 34], "language_annotation": ["A scene."]}), path)
    with pytest.raises(CorruptFileError, match="20 features"):
        SceneDataset.load(folder)


@pytest.mark.parametrize("content", ["{not json", '{"model_paths": []}'])
def test_broken_metadata_is_named(folder: Path, content: str) -> None:
    (folder / "metadata.json").write_text(content)
    with pytest.raises(CorruptFileError, match=r"metadata\.json"):
        SceneDataset.load(folder)


def test_saving_into_a_used_folder_is_refused(dataset: SceneDataset, folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="already holds"):
        dataset.save(folder)
