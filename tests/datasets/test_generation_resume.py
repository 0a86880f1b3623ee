"""Interrupted generation: what was finished is kept, and the files are those of an undisturbed run."""

from __future__ import annotations

import errno
import hashlib
import os
import pickle
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from scene_envs.datasets import SceneDataset, StorageError, generation, judge_scenes
from scene_envs.errors import CorruptFileError
from scene_envs.scene import SceneBatch
from tests.helpers.forked import forked
from tests.helpers.toy_grammars import CUPS_COUNT, ToyGrammar, generate_cups


def _hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


class _Killed(BaseException):
    """Stands for a killed process."""


def _generate_and_die(output: Path, verdicts: Callable[[SceneBatch], list[str]]) -> None:
    """Generate until more than ten candidates are judged, in chunks of five at most."""
    judged = 0

    def judge(batch: SceneBatch) -> list[str]:
        nonlocal judged
        judged += len(batch)
        if judged > 10:
            raise _Killed
        return verdicts(batch)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(generation, "judge_scenes", judge)
        patch.setattr(generation, "_MAX_CHUNK", 5)
        with pytest.raises(_Killed):
            generate_cups(output)


def _generate_slowly(output: Path) -> None:
    def slowly(batch: SceneBatch) -> list[str]:
        time.sleep(0.05)
        return judge_scenes(batch)

    generation.judge_scenes = slowly
    generation._MAX_CHUNK = 4
    generate_cups(output)


@pytest.mark.slow
def test_killed_and_started_again_the_files_are_the_same(cups: Path, tmp_path: Path) -> None:
    """Killed in the middle of the second shard; the first is whole, and the journal holds what was judged."""
    process = forked(_generate_slowly, tmp_path)
    while process.is_alive() and not (tmp_path / ".scenes-00001.parquet.journal").exists():
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
def test_what_was_judged_before_a_kill_is_not_judged_again(
    cups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _generate_and_die(tmp_path, judge_scenes)
    (journal,) = tmp_path.glob(".*.journal")
    known = journal.read_text().count("\n")
    assert 5 <= known <= 10
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join([*lines[:5], *lines[3:], f"{known} penetr"]))  # told twice; killed while it wrote a line
    counted = 0

    def count(batch: SceneBatch) -> list[str]:
        nonlocal counted
        counted += len(batch)
        return judge_scenes(batch)

    monkeypatch.setattr(generation, "judge_scenes", count)
    monkeypatch.setattr(generation, "_MAX_CHUNK", 1)
    report = generate_cups(tmp_path)
    assert counted == report.tried - known
    assert _hashes(tmp_path) == _hashes(cups)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_size_of_chunks(
    cups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "_MAX_CHUNK", 7)
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
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EACCES])
def test_a_disk_that_cannot_be_written_keeps_finished_shards(
    cups: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    write = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if "scenes-00001" in path.name:
            write(path, content[:100])
            raise OSError(number, os.strerror(number))
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        words = "the disk is full" if number == errno.ENOSPC else "Permission denied"
        with pytest.raises(StorageError, match=rf"scenes-00001.*{words}.*run again to resume"):
            generate_cups(tmp_path)
    assert not list(tmp_path.glob(".*.partial"))
    assert (tmp_path / "scenes-00000.parquet").is_file()
    generate_cups(tmp_path)
    assert _hashes(tmp_path) == _hashes(cups)


def test_the_error_of_a_full_disk_reaches_the_parent_from_a_worker() -> None:
    error = pickle.loads(pickle.dumps(StorageError("cannot write 'a': the disk is full")))
    assert isinstance(error, StorageError)
    assert "disk is full" in str(error)


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
    with pytest.raises(CorruptFileError, match=r"scenes-00001.*is damaged.*delete it"):
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

    def judge(batch: SceneBatch) -> list[str]:
        chunks.append(len(batch))
        return judge_scenes(batch)

    monkeypatch.setattr(generation, "judge_scenes", judge)
    generate_cups(tmp_path)
    assert set(chunks) == {1}
    assert _hashes(tmp_path) == _hashes(cups)


@pytest.mark.slow
def test_a_grammar_that_was_changed_since_is_judged_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = ToyGrammar.sample_array
    with monkeypatch.context() as patch:  # what an earlier grammar made was in order
        patch.setattr(ToyGrammar, "sample_array", lambda self, rng, count: sample(self, rng.spawn(1)[0], count))
        _generate_and_die(tmp_path, lambda batch: ["kept"] * len(batch))
    generate_cups(tmp_path)
    batch = SceneDataset.load(tmp_path).batch()
    assert set(judge_scenes(batch)) == {generation.KEPT}
