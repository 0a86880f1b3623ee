"""Output of each command on a very small case."""

import json

import pytest

from agents import ScenePrior
from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs import SceneBatch

pytest.importorskip("pybullet")


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> str:
    """The folder of an untrained prior with 6 slots."""
    return str(tiny_prior(slots=6).save(tmp_path_factory.mktemp("prior")))


def metrics(folder) -> dict:
    return json.loads((folder / "metrics.json").read_text())


def files(folder) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
def test_sample_then_project(prior, tmp_path, capsys):
    drawn, ready = tmp_path / "drawn", tmp_path / "ready"
    small = ["count=3", "num_steps=2", "workers=0", "pictures=1"]
    assert main(["sample", f"prior={prior}", *small, "reward=object_count", f"output={drawn}"]) == 0
    assert files(drawn) == {"config.yaml", "metrics.json", "log.txt", "scenes.safetensors", "gallery.png"}
    scenes = SceneBatch.load(drawn / "scenes.safetensors")
    assert len(scenes) == 3
    assert metrics(drawn)["objects"]["mean"] == pytest.approx(scenes.counts.double().mean().item())
    assert metrics(drawn)["reward"]["mean"] == pytest.approx(metrics(drawn)["objects"]["mean"])
    scene_file = drawn / "scenes.safetensors"
    assert main(["project", f"scenes={scene_file}", "workers=0", "pictures=1", f"output={ready}"]) == 0
    assert len(SceneBatch.load(ready / "ready.safetensors")) == 3
    assert {"before.png", "ready.png"} <= files(ready)
    assert metrics(ready)["ready"]["valid"] == 3
    assert "simulation-ready" in capsys.readouterr().out


@pytest.mark.slow
def test_the_same_seed_draws_the_same_scenes(prior, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        words = [f"prior={prior}", "count=2", "num_steps=2", "reward=null", "pictures=0", "workers=0", f"seed={seed}"]
        assert main(["sample", *words, f"output={tmp_path / name}"]) == 0
    first, again, other = ((tmp_path / name / "scenes.safetensors").read_bytes() for name in "abc")
    assert first == again != other


@pytest.mark.slow
def test_samples_are_guided_as_the_prior_says_unless_the_command_says_otherwise(prior, tmp_path, capsys):
    guided, scenes = ScenePrior.load(prior).with_physics_guidance(1.0).save(tmp_path / "guided"), {}
    for name, words in {"usual": [], "on": ["physics_guidance=1"], "off": ["physics_guidance=0"]}.items():
        words += [f"prior={guided}", "count=2", "num_steps=4", "reward=null", "pictures=0", "workers=0"]
        assert main(["sample", *words, f"output={tmp_path / name}"]) == 0
        assert metrics(tmp_path / name)["physics_guidance"] == (name != "off")
        assert ("physics_guidance=1" in capsys.readouterr().out) == (name != "off")
        scenes[name] = (tmp_path / name / "scenes.safetensors").read_bytes()
    assert scenes["usual"] == scenes["on"] != scenes["off"]


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_generate_pretrain_post_train_and_sample_the_result(tmp_path, capsys):
    data, trained, steered = (tmp_path / name for name in ("data", "trained", "steered"))
    assert main(["generate", "count=8", "shard_size=8", "workers=0", "progress=none", f"output={data}"]) == 0
    assert metrics(data)["scenes"] == 8
    small = ["network.hidden=16", "network.depth=1", "network.heads=1", "batch_size=2", "iterations=2"]
    assert main(["pretrain", f"data={data}", *small, f"output={trained}"]) == 0
    assert metrics(trained)["trained_steps"] == 2
    words = ["iterations=1", "batch_size=2", "num_steps=3", "algorithm.gradient_steps=2", "regularisation.batch_size=2"]
    words += [
        "regularisation.bank_size=8",
        "guard.scenes=2",
        "slots=6",
        "logger.report_scenes=1",
        "progress=none",
        "reward={name: clip, reward: object_count, high: 30}",
    ]
    assert main(["post-train", f"prior={trained}", *words, f"output={steered}"]) == 0
    assert metrics(steered)["iterations"] == 1
    assert {"config.yaml", "log.txt", "report.html", "curve.png", "before.png", "after.png"} <= files(steered)
    assert "simulation-ready" in capsys.readouterr().out
    words = ["count=1", "num_steps=1", "reward=null", "pictures=0", "workers=0"]
    assert main(["sample", f"prior={steered}", *words, f"output={tmp_path / 'drawn'}"]) == 0


def test_the_doctor_prints_its_screen_and_keeps_the_numbers(prior, tmp_path, capsys):
    words = [
        "batch_size=2",
        "num_steps=3",
        "algorithm.gradient_steps=2",
        "regularisation.batch_size=2",
        "regularisation.bank_size=8",
    ]
    assert main(["doctor", f"prior={prior}", *words, "guard.scenes=2", "slots=20", f"output={tmp_path}"]) == 0
    assert metrics(tmp_path)["log_ratio"] == 0
    assert "log-ratio at the start" in capsys.readouterr().out


@pytest.mark.slow
def test_search_writes_its_pictures_and_curve(prior, tmp_path, capsys):
    words = ["objective=object_count", "budget=4", "branching=2", "num_steps=2", "slots=6"]
    assert main(["search", f"prior={prior}", *words, f"output={tmp_path}"]) == 0
    assert {"best.safetensors", "before.png", "after.png", "curve.png", "config.yaml"} <= files(tmp_path)
    found = metrics(tmp_path)
    assert found["search"]["objective"] >= found["first_samples"]["objective"]
    assert "by gradient with" in capsys.readouterr().out


def test_listings_and_the_contract_check(capsys):
    assert main(["priors"]) == main(["rewards"]) == main(["check-reward", "reward=object_count"]) == 0
    printed = capsys.readouterr().out
    assert "feasible_objects: Number of free objects" in printed
    assert "'object_count' keeps its contract" in printed


def test_a_truncated_prior_exits_2(prior, tmp_path, capsys):
    broken = tiny_prior(slots=6).save(tmp_path / "broken")
    weights = broken / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert main(["sample", f"prior={broken}", f"output={tmp_path / 'out'}"]) == 2
    assert "model.safetensors" in capsys.readouterr().err
