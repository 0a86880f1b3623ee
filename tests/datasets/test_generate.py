"""Generation: what was asked for, verified by physics, resumed, with one normaliser per grammar."""

from __future__ import annotations

import errno
import hashlib
import io
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_envs.datasets import SceneDataset, generate, generation
from scene_envs.datasets.generation import fixed_normalizer, generation_progress, judge_scenes
from scene_envs.errors import CorruptFileError, InvalidInputError, PhysicsError, StorageError, UnknownNameError
from scene_envs.grammars import get_grammar, register_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.fake_gpu import fake_gpu
from tests.helpers.forked import forked
from tests.helpers.toy_grammars import CUPS_COUNT, TYPE, ToyGrammar, generate_cups, toy_cups


def test_shards_hold_the_scenes_that_were_asked_for(cups: Path) -> None:
    dataset = SceneDataset.load(cups)
    assert len(dataset) == CUPS_COUNT
    assert dataset.complete
    sizes = [len(SceneDataset.load(path)) for path in sorted(cups.glob("*.parquet"))]
    assert sizes == [15, 15, 10]
    assert [path.name for path in cups.iterdir() if path.name.startswith(".")] == []


def test_scenes_are_distinct(cups: Path) -> None:
    tensor = SceneDataset.load(cups).tensor
    assert len(torch.unique(tensor.flatten(1), dim=0)) == CUPS_COUNT


def test_every_scene_has_three_prompts(cups: Path) -> None:
    dataset = SceneDataset.load(cups)
    assert all(len(prompts) == 3 for prompts in dataset.prompt_sets)
    assert dataset.prompts == [prompts[0] for prompts in dataset.prompt_sets]


@pytest.mark.slow
def test_kept_scenes_pass_physics_and_thrown_ones_are_accounted_for(cups: Path, tmp_path: Path) -> None:
    """The toy grammar puts two cups in one place in 3/16 of its scenes."""
    dataset = SceneDataset.load(cups)
    assert judge_scenes(dataset.batch()) == [""] * CUPS_COUNT
    report = generate_cups(tmp_path)
    assert report.tried == CUPS_COUNT + report.reasons["penetration"]
    assert 2 <= report.reasons["penetration"] <= 25
    assert report.reasons["toy reason"] > 10


def test_an_unknown_backend_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="processes, ray"):
        generate_cups(tmp_path, backend="rai")


def test_a_grammar_of_a_notebook_is_refused_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import __main__

    monkeypatch.setattr(toy_cups, "__module__", "__main__")
    monkeypatch.setattr(__main__, "toy_cups", toy_cups, raising=False)
    monkeypatch.delattr(__main__, "__file__", raising=False)
    with pytest.raises(InvalidInputError, match=r"notebook.*workers=0"):
        generate_cups(tmp_path, count=1, workers=1)


def test_another_seed_gives_other_scenes(cups: Path, tmp_path: Path) -> None:
    generate_cups(tmp_path, count=5, seed=4)
    assert not torch.equal(SceneDataset.load(tmp_path).tensor, SceneDataset.load(cups).tensor[:5])


def test_a_folder_made_with_other_settings_is_refused(cups: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"'seed': 3.*'seed': 9"):
        generate_cups(cups, seed=9)


@pytest.mark.parametrize("bad", [{"count": 0}, {"shard_size": 0}, {"workers": -1}, {"seed": -1}])
def test_bad_arguments_are_named(bad: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(bad))):
        generate_cups(tmp_path, **bad)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match="not a folder"):
        generate_cups(tmp_path / "file")


def test_an_unknown_grammar_offers_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="dimsum_table"):
        generate("dim_sum_table", 1, tmp_path)


def test_a_grammar_that_workers_cannot_import_is_refused_with_the_remedy(tmp_path: Path) -> None:
    @register_grammar("local")
    def local() -> ToyGrammar:
        return toy_cups()

    with pytest.raises(InvalidInputError, match="workers=0"):
        generate("local", 2, tmp_path, workers=1, verify=False, progress=False)


def test_a_grammar_of_which_nothing_passes_is_given_up_with_the_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "_MAX_FRUITLESS", 40)
    with pytest.raises(PhysicsError, match="outside workspace"):
        generate_cups(tmp_path, grammar="toy_hopeless")


def test_a_log_gets_lines_with_rate_and_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(generation, "_EVERY", 0.0)
    with generation_progress("Generating tea", 100, 1000, True) as report:
        report(10, 12, {"penetration": 2})
        report(5, 6, {"no room": 7})
    first, second = stream.getvalue().strip().splitlines()
    assert first.startswith("Generating tea: 110/1000, ")
    assert first.endswith("scenes/s, penetration 2")
    assert second.endswith("no room 7, penetration 2")
    assert "115/1000" in second


def _hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def _generate_slowly(output: Path) -> None:
    def slowly(batch: SceneBatch, physics: str) -> list[str]:
        time.sleep(0.05)
        return judge_scenes(batch, physics)

    generation.judge_scenes = slowly
    generation._MAX_CHUNK = 4
    generate_cups(output)


@pytest.mark.slow
def test_killed_and_started_again_the_files_are_the_same(cups: Path, tmp_path: Path) -> None:
    """Killed in the middle of the second shard; the first is whole."""
    process = forked(_generate_slowly, tmp_path)
    while process.is_alive() and not (tmp_path / "scenes-00000.parquet").exists():
        time.sleep(0.002)
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert (tmp_path / "scenes-00000.parquet").is_file()
    assert not (tmp_path / "scenes-00001.parquet").exists()
    (tmp_path / ".scenes-00001.parquet.999999999.partial").write_bytes(b"PAR1 half a file")  # of a process that ended
    generate_cups(tmp_path)
    assert _hashes(tmp_path) == _hashes(cups)


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
def test_two_workers_write_the_same_files_and_a_dying_one_is_replaced(
    cups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers here begin as copies of this process; those of ``test_own_scene_type.py`` are new interpreters."""
    monkeypatch.setenv("SCENE_ENVS_TEST_PARENT", str(os.getpid()))
    monkeypatch.setenv("SCENE_ENVS_TEST_FLAG", str(tmp_path / "died"))
    report = generate_cups(tmp_path / "data", grammar="toy_mortal", workers=2)
    assert (tmp_path / "died").exists()
    assert report.scenes == CUPS_COUNT
    made, wanted = _hashes(tmp_path / "data"), _hashes(cups)
    del made["metadata.json"], wanted["metadata.json"]  # it names the grammar
    assert made == wanted


@pytest.mark.slow
def test_a_disk_that_is_full_keeps_finished_shards(cups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if "scenes-00001" in path.name:
            write(path, content[:100])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(StorageError, match=r"scenes-00001.*the disk is full.*run again to resume"):
            generate_cups(tmp_path)
    assert not list(tmp_path.glob(".*.partial"))
    assert (tmp_path / "scenes-00000.parquet").is_file()
    generate_cups(tmp_path)
    assert _hashes(tmp_path) == _hashes(cups)


def test_a_finished_dataset_is_left_alone(cups: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in cups.iterdir()}
    generate_cups(cups)
    assert {path: path.stat().st_mtime_ns for path in cups.iterdir()} == before


def test_a_broken_shard_is_named_before_work_starts(cups: Path, tmp_path: Path) -> None:
    for path in cups.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    shard = tmp_path / "scenes-00001.parquet"
    shard.write_bytes(shard.read_bytes()[:-50])
    with pytest.raises(CorruptFileError, match=r"scenes-00001.*delete it"):
        generate_cups(tmp_path)
    flipped = bytearray((cups / shard.name).read_bytes())
    flipped[len(flipped) // 4] ^= 1  # in a page of scenes; the footer stands at the end
    shard.write_bytes(flipped)
    with pytest.raises(CorruptFileError, match=r"scenes-00001.*CRC checksum verification failed.*delete it"):
        generate_cups(tmp_path)
    shard.write_bytes((tmp_path / "scenes-00002.parquet").read_bytes())
    with pytest.raises(CorruptFileError, match=r"holds 10 scenes, expected 15"):
        generate_cups(tmp_path)
    shard.unlink()
    generate_cups(tmp_path)
    assert _hashes(tmp_path) == _hashes(cups)


@pytest.mark.slow
def test_slow_grammars_report_scene_by_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cups: Path) -> None:
    """When a scene takes as long as a chunk may, chunks have one scene."""
    monkeypatch.setattr(generation, "_CHUNK_SECONDS", 0.0)
    chunks: list[int] = []

    def judge(batch: SceneBatch, physics: str) -> list[str]:
        chunks.append(len(batch))
        return judge_scenes(batch, physics)

    monkeypatch.setattr(generation, "judge_scenes", judge)
    generate_cups(tmp_path)
    assert set(chunks) == {1}
    assert _hashes(tmp_path) == _hashes(cups)


def test_the_normalizer_is_fixed_by_the_grammar_and_fills_the_range(cups: Path) -> None:
    normalizer = fixed_normalizer(ToyGrammar())
    dataset = SceneDataset.load(cups)
    assert torch.equal(normalizer.scale, dataset.normalizer.scale)
    assert normalizer.input_min[:2].tolist() == pytest.approx([-0.4, -0.4])
    assert normalizer.input_max[:2].tolist() == pytest.approx([0.4, 0.4])
    assert normalizer.is_constant.nonzero().flatten().tolist() == [2, 5, 8, 9, 10]  # height, and the tilt
    normalised = normalizer.normalize(dataset.tensor)
    assert normalised.abs().max() <= 1.0
    assert set(normalised[..., 11:].unique().tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize("lean", [1.0, 0.003])
def test_rotations_take_the_full_range_when_any_object_leans(lean: float) -> None:
    """A cup in 300 leans: enough for all entries to vary, by its lean about one axis or any other."""
    normalizer = fixed_normalizer(ToyGrammar(lean=lean))
    assert normalizer.input_min[3:12].tolist() == [-1.0] * 9
    assert normalizer.input_max[3:12].tolist() == [1.0] * 9
    leaning = SceneBatch(torch.from_numpy(ToyGrammar(lean=1.0).sample_array(np.random.default_rng(0), 20)), TYPE)
    torch.testing.assert_close(normalizer.unnormalize(normalizer.normalize(leaning.tensor)), leaning.tensor)


def test_a_scene_that_the_normalizer_cannot_hold_is_thrown_away_and_counted(tmp_path: Path) -> None:
    generate_cups(tmp_path, count=1, verify=False)  # its normalizer knows upright cups alone
    (tmp_path / "scenes-00000.parquet").unlink()
    register_grammar("toy_cups")(lambda: ToyGrammar(lean=0.5))
    report = generate_cups(tmp_path, count=1, verify=False)
    assert report.tried == 1 + report.reasons.get("outside the normalizer", 0)
    loaded = SceneDataset.load(tmp_path).tensor
    assert (loaded[:, :, 11] > 0.999).any(dim=1).all()
    assert loaded[..., [5, 8, 9, 10]].abs().max() == 0.0


def test_objects_welded_at_generated_poses_are_normalised_like_any_other() -> None:
    """Tables of a room stand anywhere in its workspace, turned about z."""

    class Room(ToyGrammar):
        def sample_array(self, rng: np.random.Generator, count: int) -> np.ndarray:
            scenes = super().sample_array(rng, count)
            scenes[:, 4] = 0.0
            scenes[:, 4, :3] = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.0], (count, 3))
            angle = rng.uniform(0, 2 * np.pi, count)
            scenes[:, 4, [3, 7]], scenes[:, 4, 4], scenes[:, 4, 6] = (
                np.cos(angle)[:, None],
                -np.sin(angle),
                np.sin(angle),
            )
            scenes[:, 4, 11] = scenes[:, 4, 12] = 1.0
            return scenes

    room = Room()
    normalizer = fixed_normalizer(room)  # type: ignore[arg-type]
    scenes = torch.from_numpy(room.sample_array(np.random.default_rng(1), 100)).float()
    assert normalizer.normalize(scenes).abs().max() <= 1.0
    torch.testing.assert_close(normalizer.unnormalize(normalizer.normalize(scenes)), scenes)


def test_verification_keeps_grammar_scenes_and_drops_broken_ones_with_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    good = get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)
    tensor = good.tensor.clone()
    tensor[1, 1, 0] = 3.0  # off the table
    tensor[2, 2, :3] = tensor[2, 1, :3]  # one object inside another
    tensor[3, 1, 2] = 0.3  # in the air: it falls
    batch, expected = (
        SceneBatch(tensor, good.scene_type),
        ["", "outside workspace", "penetration", "moved while settling"],
    )
    assert judge_scenes(batch) == [*expected, "", ""]
    with fake_gpu(monkeypatch):
        assert judge_scenes(batch[:4].to("cuda")) == expected
