"""``scene-envs evaluate``: what it writes, that it goes on where it stopped, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pyarrow.parquet as parquet
import pytest
import torch

from agents.cli import main
from agents.evaluation import grammar_scenes
from agents.priors import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.simulators import no_simulator

pytest.importorskip("pybullet")

QUICK = ("count=3", "num_steps=1", "workers=0", "pictures=0")


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_prior(slots=6).save(tmp_path_factory.mktemp("prior"))


def dataset(folder: Path, scene_type: str = "dimsum_table", count: int = 24) -> Path:
    batch = grammar_scenes(scene_type, count, seed=5)
    prompts = ["A scene with 1 object."] * count
    return SceneDataset(batch.tensor, prompts, Normalizer.fit(batch.tensor), batch.scene_type).save(folder)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dataset(tmp_path_factory.mktemp("data") / "dimsum")


def metrics(folder: Path) -> dict[str, float]:
    found: dict[str, float] = json.loads((folder / "metrics.json").read_text())
    return found


def log(folder: Path) -> str:
    return (folder / "log.txt").read_text()


def test_every_figure_stands_beside_its_floor(prior: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    words = ["evaluate", f"prior={prior}", f"data={data}", *QUICK, "measures=[layout,physics,novelty]"]
    assert main([*words, f"output={tmp_path}"]) == 0
    found = metrics(tmp_path)
    assert found["scenes"] == 3
    assert found["floor_stable_fraction"] == found["floor_feasible_fraction"] == 1.0
    assert found["floor_collision_rate"] == found["floor_copied_fraction"] == 0.0
    shown = capsys.readouterr().out
    assert "| figure | samples | real | how to read |" in shown
    assert "| category_kl_e4 |" in shown
    assert (tmp_path / "metrics.md").read_text().strip() in shown
    assert len(SceneBatch.load(tmp_path / "scenes.safetensors")) == 3


@pytest.mark.slow
def test_what_is_measured_already_is_not_measured_again(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    words = ["evaluate", f"prior={prior}", *QUICK, f"output={tmp_path}"]
    assert main([*words, "measures=layout"]) == 0
    first, drawn = metrics(tmp_path), (tmp_path / "scenes.safetensors").stat().st_mtime_ns
    assert main([*words, "measures=[layout,physics]"]) == 0
    second = metrics(tmp_path)
    assert log(tmp_path).count("layout measured in") == 1
    assert log(tmp_path).count("physics measured in") == 1
    assert (tmp_path / "scenes.safetensors").stat().st_mtime_ns == drawn
    assert all(second[name] == value for name, value in first.items() if name != "evaluation")
    assert "feasible_fraction" in second
    assert "feasible_fraction" not in first
    path = tmp_path / "metrics.json"
    whole = path.read_text()
    for damaged, reason in (
        (whole[:200], "cut off"),
        (whole.replace('"objects_max": ', '"objects_max": 1'), "changed"),
    ):
        path.write_text(damaged)
        assert main([*words, "measures=layout"]) == 2
        assert re.search(rf"metrics.json' (is|was) {reason}.*remove it to measure anew", capsys.readouterr().err)


@pytest.mark.slow
def test_other_keys_are_refused_and_other_weights_of_the_prior_measured_anew(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    words, out = ["evaluate", *QUICK, "measures=layout", f"output={tmp_path / 'out'}"], tmp_path / "out"
    moved = tmp_path / "moved"
    tiny_prior(slots=6, seed=1).save(moved)
    assert main([*words, f"prior={moved}"]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.name != "log.txt"}
    for other, told in (([f"prior={moved}", "seed=1"], "seed was 0, is 1"), ([f"prior={prior}"], "prior was")):
        assert main([*words, *other]) == 2
        assert f"was written with other keys ({told}" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.name != "log.txt"} == before
    tiny_prior(slots=6, seed=2).save(moved)
    assert main([*words, f"prior={moved}"]) == 0
    assert "measuring anew" in capsys.readouterr().out
    assert log(out).count("layout measured in") == 2


@pytest.mark.slow
def test_other_guidance_measures_the_prompts_alone_anew(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    reads = tiny_prior(process="mixed", text=True).save(tmp_path / "reads")
    words = ["evaluate", f"prior={reads}", *QUICK, "measures=[layout,prompts]", f"output={tmp_path / 'out'}"]
    for guidance, again in ((0, False), (2, True), (2, False)):
        assert main([*words, f"guidance={guidance}"]) == 0
        assert ("has other guidance: measuring the prompts anew" in capsys.readouterr().out) == again
    assert log(tmp_path / "out").count("layout measured in") == 1
    assert log(tmp_path / "out").count("prompts measured in") == 2
    assert metrics(tmp_path / "out")["prompt_guidance"] == 2
    assert "| num_steps | 1 |" in (tmp_path / "out" / "metrics.md").read_text()


def test_physics_guidance_guides_all_samples_and_needs_a_folder_of_its_own(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    words = ["evaluate", f"prior={prior}", *QUICK, "num_steps=4", "measures=layout", f"output={tmp_path / 'out'}"]
    assert main([*words, "physics_guidance=1"]) == 0
    saved = SceneBatch.load(tmp_path / "out" / "scenes.safetensors")
    expected = ScenePrior.load(prior).sample(3, num_steps=4, physics_guidance=1.0)
    assert torch.equal(saved.tensor, expected.tensor)
    assert metrics(tmp_path / "out")["physics_guidance"] == 1
    assert "| physics_guidance | 1 |" in (tmp_path / "out" / "metrics.md").read_text()
    assert main(words) == 2
    assert "physics_guidance was 1.0, is 0.0" in capsys.readouterr().err


def test_all_leaves_out_what_cannot_be_measured_and_says_why(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["evaluate", f"prior={prior}", *QUICK, "project=false", f"output={tmp_path}"]) == 0
    shown = capsys.readouterr().out
    assert "- novelty not measured: novelty needs data=" in shown
    assert "- prompts not measured: prompt-following needs a prior that reads prompts" in shown
    assert "- classifier not measured:" in shown
    assert "ready_objects" not in metrics(tmp_path)
    assert "feasible_objects" in metrics(tmp_path)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["measures=novelty"], "novelty needs data="),
        (["measures=prompts"], "needs a prior that reads prompts"),
        (["measures=noveltie"], "did you mean 'novelty'"),
        (["data=nowhere", "measures=layout"], "data='nowhere': nothing is at 'nowhere'"),
        (["heldout=somewhere", "measures=layout"], "needs data="),
        (["count=1", "measures=layout"], "count=1 must be at least 2"),
        (["prompt_count=1"], "prompt_count=1 must be from 2 to count="),
        (["count=4", "prompt_count=5"], "prompt_count=5 must be from 2 to count=4"),
    ],
)
def test_what_cannot_be_done_is_refused_in_words(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture, words: list[str], message: str
) -> None:
    assert main(["evaluate", f"prior={prior}", *QUICK, *words, f"output={tmp_path}"]) == 2
    assert message in capsys.readouterr().err


def test_a_dataset_of_another_scene_type_is_refused(prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    other = dataset(tmp_path / "shelves", "pantry_shelf", 8)
    words = ["evaluate", f"prior={prior}", f"data={other}", *QUICK, "measures=layout", f"output={tmp_path / 'out'}"]
    assert main(words) == 2
    assert "holds scenes of 'pantry_shelf', the samples are of 'dimsum_table'" in capsys.readouterr().err


def test_a_dataset_without_its_column_is_refused(prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = dataset(tmp_path / "broken", count=8)
    (shard,) = folder.glob("*.parquet")
    parquet.write_table(parquet.read_table(shard).drop_columns(["scenes"]), shard)
    words = ["evaluate", f"prior={prior}", f"data={folder}", *QUICK, "measures=layout", f"output={tmp_path / 'out'}"]
    assert main(words) != 0
    assert "scenes" in capsys.readouterr().err


def test_a_dataset_with_a_scene_that_is_not_finite_is_refused(
    prior: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    batch = grammar_scenes("dimsum_table", 8, seed=5)
    tensor = batch.tensor.clone()
    tensor[3, 2, 0] = torch.nan
    folder = SceneDataset(tensor, ["A scene."] * 8, Normalizer.fit(batch.tensor), batch.scene_type).save(tmp_path / "n")
    words = ["evaluate", f"prior={prior}", f"data={folder}", *QUICK, "measures=layout", f"output={tmp_path / 'out'}"]
    assert main(words) != 0
    message = capsys.readouterr().err
    assert "Traceback" not in message
    assert "row 3" in message
    assert "slot 2" in message


def test_without_a_simulator_the_rest_is_measured_and_physics_later(
    prior: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    words = ["evaluate", f"prior={prior}", *QUICK, "measures=[layout,physics,ready]", f"output={tmp_path}"]
    with monkeypatch.context() as without:
        no_simulator(without)
        assert main(words) == 0
    found = metrics(tmp_path)
    assert "collision_rate" in found
    assert not {"feasible_fraction", "stable_fraction", "ready_fraction"} & set(found)
    left_out = found["evaluation"]["left_out"]
    assert left_out == {"physics": "feasible figures: no simulator here", "ready": "no simulator here"}
    assert "- physics not measured: feasible figures: no simulator here" in capsys.readouterr().out
    assert "feasible left out: no simulator here" in log(tmp_path)
    assert main(words) == 0
    found = metrics(tmp_path)
    assert {"collision_rate", "feasible_fraction", "ready_fraction"} <= set(found)
    assert found["evaluation"]["left_out"] == {}
    assert log(tmp_path).count("layout measured in") == 1
