"""``scene-envs export``, and ``export=`` of ``scene-envs sample``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from agents.cli import main
from agents.priors import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import all_scenes, jittered_scene, laid_scene


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> str:
    """The folder of an untrained prior with 6 slots."""
    return str(tiny_prior(slots=6).save(tmp_path_factory.mktemp("prior")))


def metrics(folder) -> dict:
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.slow
def test_a_scene_file_in_some_formats(tmp_path, capsys):
    scenes = all_scenes().save(tmp_path / "scenes.safetensors")
    out = tmp_path / "out"
    words = ["formats=[drake,mjcf]", "count=2", "workers=0", f"output={out}"]
    assert main(["export", f"scenes={scenes}", *words]) == 0
    assert {path.name for path in out.iterdir()} == {
        "assets", "scene_000", "scene_001", "export.json", "package.xml", "config.yaml", "metrics.json", "log.txt",
    }  # fmt: skip
    assert {path.name for path in (out / "scene_001").iterdir()} == {"scene.dmd.yaml", "scene.xml"}
    assert (metrics(out)["scenes"], metrics(out)["overlapping"]) == (2, 1)
    printed = capsys.readouterr().out
    assert "2 scenes as drake, mjcf" in printed
    assert "in 1 of 2 scenes objects overlap" in printed
    assert main(["export", f"scenes={scenes}", *words]) == 0  # again, into the same folder


def test_a_run_gives_its_simulation_ready_scenes(tmp_path):
    run = tmp_path / "run"
    jittered_scene(3).save(run / "scenes.safetensors")
    laid_scene().save(run / "ready.safetensors")
    assert main(["export", f"scenes={run}", "formats=npz", "workers=0", f"output={tmp_path / 'out'}"]) == 0
    found = np.load(tmp_path / "out" / "scene_000" / "scene.npz")["translations"]
    np.testing.assert_allclose(found, laid_scene().translations[0, :10], atol=1e-7)


def test_a_dataset_is_exported(tmp_path):
    batch = laid_scene().with_slots(34)
    dataset = SceneDataset(batch.tensor, ["a table"], Normalizer.fit(batch.tensor), batch.scene_type)
    dataset.save(tmp_path / "data")
    words = ["formats=npz", "count=5", "workers=0", f"output={tmp_path / 'out'}"]
    assert main(["export", f"scenes={tmp_path / 'data'}", *words]) == 0
    found = np.load(tmp_path / "out" / "scene_000" / "scene.npz")["translations"]
    np.testing.assert_allclose(found, laid_scene().translations[0, :10], atol=1e-6)


def test_a_prior_is_sampled_and_made_ready(prior, tmp_path):
    pytest.importorskip("pybullet")
    words = ["count=2", "num_steps=2", "formats=mjcf", "project=true", "workers=0", f"output={tmp_path}"]
    assert main(["export", f"prior={prior}", *words]) == 0
    assert len(SceneBatch.load(tmp_path / "ready.safetensors")) == 2
    assert (tmp_path / "scene_001" / "scene.xml").is_file()
    assert metrics(tmp_path)["ready"]["valid"] == 2


@pytest.mark.slow
def test_scenes_of_a_prior_are_guided_as_the_prior_says_unless_the_command_says_otherwise(prior, tmp_path):
    guided, scenes = ScenePrior.load(prior).with_physics_guidance(1.0).save(tmp_path / "guided"), {}
    for name, words in {"usual": [], "on": ["physics_guidance=1"], "off": ["physics_guidance=0"]}.items():
        words += [f"prior={guided}", "count=2", "num_steps=4", "formats=npz", "workers=0"]
        assert main(["export", *words, f"output={tmp_path / name}"]) == 0
        scenes[name] = (tmp_path / name / "scenes.safetensors").read_bytes()
    assert scenes["usual"] == scenes["on"] != scenes["off"]


def test_sample_exports_what_it_made_ready(prior, tmp_path):
    pytest.importorskip("pybullet")
    words = ["count=2", "num_steps=2", "reward=null", "pictures=0", "workers=0", "project=true", "export=[npz, drake]"]
    assert main(["sample", f"prior={prior}", *words, f"output={tmp_path}"]) == 0
    ready = SceneBatch.load(tmp_path / "ready.safetensors")
    found = np.load(tmp_path / "export" / "scene_001" / "scene.npz")
    np.testing.assert_array_equal(found["translations"].astype(np.float32), ready.translations[1][~ready.is_empty[1]])
    assert (tmp_path / "export" / "scene_001" / "scene.dmd.yaml").is_file()
    assert metrics(tmp_path)["export"]["formats"] == ["npz", "drake"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["export"], "name either a scene file"),
        (["export", "scenes=a", "prior=dimsum_table"], "name either a scene file"),
        (["export", "scenes=nowhere.safetensors"], "scenes='nowhere.safetensors': no scene file"),
        (["export", "scenes=OUT/..", "formats=npz"], "no parquet"),
        (["export", "scenes=OUT", "formats=mjfc"], "did you mean 'mjcf'?"),
        (["export", "scenes=OUT", "count=0"], "count=0 must be at least 1"),
        (["sample", "export=[drake, urfd]"], "did you mean 'urdf'?"),
    ],
)
def test_wrong_input_exits_2_with_one_line(words, message, tmp_path, capsys):
    (tmp_path / "out").mkdir()
    assert main([*(word.replace("OUT", str(tmp_path / "out")) for word in words), f"output={tmp_path / 'out'}"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.strip().splitlines()) == 1
