"""Generation: reproducible, resumable, verified, and clear about what it refuses."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import time
from collections import Counter
from multiprocessing import current_process
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_envs.datasets import SceneDataset, fixed_normalizer, generate, verify_scenes
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import Grammar, get_grammar, register_grammar
from scene_envs.scene import SceneBatch


def _hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def _generate(output: Path, *, count: int = 70, workers: int = 0, **changes: object) -> None:
    options = {"seed": 3, "verify": False, "shard_size": 30, "progress": False} | changes
    generate("dimsum_table", count, output, workers=workers, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reference")
    _generate(folder)
    return folder


def test_shards_hold_the_scenes_that_were_asked_for(reference: Path) -> None:
    dataset = SceneDataset.load(reference)
    assert len(dataset) == 70
    assert dataset.complete
    sizes = [len(SceneDataset.load(path)) for path in sorted(reference.glob("*.parquet"))]
    assert sizes == [30, 30, 10]


def test_scenes_are_distinct(reference: Path) -> None:
    tensor = SceneDataset.load(reference).tensor
    assert len(torch.unique(tensor.flatten(1), dim=0)) == 70


def test_a_killed_run_resumes_to_identical_files(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in the middle of the second shard, with a half-written file left behind."""
    module = sys.modules["scene_envs.datasets.generate"]  # the package exports a function of that name

    class Killed(BaseException):
        pass

    calls = 0

    def killed_at_third_write(*args: object) -> None:
        nonlocal calls
        calls += 1
        if calls == 2:
            (tmp_path / ".scenes-00001.parquet.partial").write_bytes(b"PAR1 half a file")
            raise Killed
        write(*args)  # type: ignore[arg-type]

    write = module.store.write_shard
    with monkeypatch.context() as patch:
        patch.setattr(module.store, "write_shard", killed_at_third_write)
        with pytest.raises(Killed):
            _generate(tmp_path)
    assert [path.name for path in sorted(tmp_path.glob("[!.]*.parquet"))] == ["scenes-00000.parquet"]
    _generate(tmp_path)
    assert _hashes(tmp_path) == _hashes(reference)


def test_a_run_killed_by_the_system_resumes_to_identical_files(reference: Path, tmp_path: Path) -> None:
    options = {"seed": 3, "workers": 0, "verify": False, "shard_size": 30, "progress": False}
    code = f"from scene_envs.datasets import generate\ngenerate('dimsum_table', 70, {str(tmp_path)!r}, **{options})"
    process = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    while process.poll() is None and not any(tmp_path.glob("scenes-*.parquet")):
        time.sleep(0.005)
    process.kill()
    process.wait()
    assert (tmp_path / "scenes-00000.parquet").is_file()
    _generate(tmp_path)
    assert _hashes(tmp_path) == _hashes(reference)


def _mortal_grammar() -> Grammar:
    """Dimsum, but the first process that uses it dies; the flag file says that it happened."""
    flag = Path(os.environ["SCENE_ENVS_TEST_FLAG"])
    grammar = get_grammar("dimsum_table")
    if current_process().name != "MainProcess" and not flag.exists():
        flag.touch()
        os._exit(1)
    return grammar


def test_a_worker_that_dies_is_replaced_and_nothing_is_lost(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCENE_ENVS_TEST_FLAG", str(tmp_path / "died"))
    register_grammar("mortal")(_mortal_grammar)
    generate("mortal", 30, tmp_path / "data", seed=3, workers=1, verify=False, shard_size=30, progress=False)
    assert (tmp_path / "died").exists()
    expected = _hashes(reference)["scenes-00000.parquet"]
    assert _hashes(tmp_path / "data")["scenes-00000.parquet"] == expected


def test_two_workers_write_the_same_files_as_this_process(reference: Path, tmp_path: Path) -> None:
    _generate(tmp_path, workers=2)
    assert _hashes(tmp_path) == _hashes(reference)


def test_a_finished_dataset_is_left_alone(reference: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in reference.iterdir()}
    _generate(reference)
    assert {path: path.stat().st_mtime_ns for path in reference.iterdir()} == before


def test_another_seed_gives_other_scenes(reference: Path, tmp_path: Path) -> None:
    _generate(tmp_path, count=5, seed=4)
    assert not torch.equal(SceneDataset.load(tmp_path).tensor, SceneDataset.load(reference).tensor[:5])


def test_a_folder_made_with_other_settings_is_refused(reference: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"'seed': 3.*'seed': 9"):
        _generate(reference, seed=9)


@pytest.mark.parametrize("bad", [{"count": 0}, {"shard_size": 0}, {"workers": -1}, {"seed": -1}])
def test_bad_arguments_are_named(bad: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(bad))):
        _generate(tmp_path, **bad)  # type: ignore[arg-type]


def test_an_unknown_grammar_offers_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="dimsum_table"):
        generate("dim_sum_table", 1, tmp_path)


def test_a_grammar_that_workers_cannot_import_is_refused_with_the_remedy(tmp_path: Path) -> None:
    @register_grammar("local")
    def local() -> Grammar:
        return get_grammar("dimsum_table")

    with pytest.raises(InvalidInputError, match="workers=0"):
        generate("local", 2, tmp_path, workers=1, verify=False, progress=False)


def test_the_normalizer_is_fixed_by_the_grammar_and_fills_the_range(reference: Path) -> None:
    normalizer = fixed_normalizer(get_grammar("dimsum_table"))
    dataset = SceneDataset.load(reference)
    assert torch.equal(normalizer.scale, dataset.normalizer.scale)
    assert normalizer.input_min[:3].tolist() == pytest.approx([-0.49, -0.49, 0.0])
    assert normalizer.input_max[:3].tolist() == pytest.approx([0.49, 0.49, 9 * 0.091])
    tilt = torch.tensor([5, 8, 9, 10])
    assert normalizer.is_constant.nonzero().flatten().tolist() == tilt.tolist()
    normalised = normalizer.normalize(dataset.tensor)
    assert normalised.abs().max() <= 1.0
    assert set(normalised[..., 11:].unique().tolist()) == {-1.0, 1.0}


def test_verification_keeps_grammar_scenes_and_drops_broken_ones_with_reasons() -> None:
    good = get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)
    tensor = good.tensor.clone()
    tensor[1, 1, 0] = 3.0  # off the table
    tensor[2, 2, :3] = tensor[2, 1, :3]  # one object inside another
    tensor[3, 1, 2] = 0.3  # in the air: it falls
    reasons: Counter[str] = Counter()
    kept = verify_scenes(SceneBatch(tensor, good.scene_type), reasons)
    assert kept.tolist() == [True, False, False, False, True, True]
    assert +reasons == {"outside workspace": 1, "penetration": 1, "moved while settling": 1}


def test_generation_fills_shards_past_scenes_that_verification_drops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules["scene_envs.datasets.generate"]  # the package exports a function of that name

    def every_other(batch: SceneBatch, reasons: Counter[str]) -> torch.Tensor:
        reasons["penetration"] += len(batch) // 2
        return torch.arange(len(batch)) % 2 == 0

    monkeypatch.setattr(module, "verify_scenes", every_other)
    report = generate("dimsum_table", 40, tmp_path, workers=0, progress=False)
    assert len(SceneDataset.load(tmp_path)) == 40
    assert report.tried == 96
    assert report.reasons["penetration"] == 48
