"""Commands on very small cases: what each prints and writes, inpainting, prompts, and checkpoint imports."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from agents.cli import main
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.checkpoints import derived_seed
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type
from tests.helpers.authors_flux import random_state, write_checkpoint
from tests.helpers.simulators import no_simulator

pytestmark = pytest.mark.usefixtures("blank_curves")


@pytest.fixture(scope="module")
def prior(tmp_path_factory) -> str:
    """The folder of an untrained prior with 6 slots."""
    pytest.importorskip("pybullet")
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


def test_a_sample_without_a_simulator_has_no_reward_and_says_why(prior, tmp_path, monkeypatch, capsys):
    no_simulator(monkeypatch)
    words = ["sample", f"prior={prior}", "count=2", "num_steps=2", "workers=0", "pictures=1", f"output={tmp_path}"]
    assert main(words) == 0
    assert metrics(tmp_path)["left_out"] == {"reward": "no simulator here"}
    assert "reward" not in metrics(tmp_path)
    assert "reward left out: no simulator here" in (tmp_path / "log.txt").read_text()
    assert {"scenes.safetensors", "gallery.png"} <= files(tmp_path)


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


@pytest.fixture(scope="module")
def inpainting_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("inpainting")
    tiny_prior(process="mixed").save(folder / "prior")
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    return scenes.save(folder / "scenes.safetensors"), folder / "prior"


def test_complete_adds_and_keeps(inpainting_files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = inpainting_files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "slots=40", "num_steps=3", "pictures=0", "count=2"]
    assert main([*words, f"output={tmp_path}"]) == 0
    before, after = SceneBatch.load(scenes)[:2], SceneBatch.load(tmp_path / "scenes.safetensors")
    assert after.tensor.shape == (2, 40, 20)
    present = ~before.is_empty
    assert (after.tensor[:, :34][present] == before.tensor[present]).all()
    assert json.loads((tmp_path / "metrics.json").read_text())["added"] >= 0


def test_complete_adds_no_more_than_fill(inpainting_files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = inpainting_files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "fill=2", "num_steps=3", "pictures=0"]
    assert main([*words, f"output={tmp_path}"]) == 0
    before, after = SceneBatch.load(scenes), SceneBatch.load(tmp_path / "scenes.safetensors")
    assert bool((after.counts - before.counts <= 2).all())
    assert bool((after.counts > before.counts).any())
    assert main([*words, "fill=-1", f"output={tmp_path / 'wrong'}"]) == 2


@pytest.mark.parametrize("command", ["complete", "rearrange"])
def test_fresh_samples_are_inpainted(inpainting_files: tuple[Path, Path], tmp_path: Path, command: str) -> None:
    _, prior = inpainting_files
    words = [command, f"prior={prior}", "count=2", "num_steps=3", "pictures=0", "seed=4", f"output={tmp_path}"]
    assert main(words) == 0
    fresh = ScenePrior.load(prior).sample(2, num_steps=3, seed=derived_seed(4, 1))  # not the noise of the inpainting
    after = SceneBatch.load(tmp_path / "scenes.safetensors")
    assert len(after) == 2
    if command == "complete":
        assert bool((after.tensor[~fresh.is_empty] == fresh.tensor[~fresh.is_empty]).all())
    else:
        assert torch.equal(after.categories, fresh.categories)


@pytest.mark.slow
def test_rearrange_moves_and_keeps_what_there_is(inpainting_files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = inpainting_files
    words = ["rearrange", f"scenes={scenes}", f"prior={prior}", "num_steps=3", "pictures=2", f"output={tmp_path}"]
    assert main(words) == 0
    before, after = SceneBatch.load(scenes), SceneBatch.load(tmp_path / "scenes.safetensors")
    assert (after.categories == before.categories).all()
    assert json.loads((tmp_path / "metrics.json").read_text())["mean_distance_m"] > 0.01
    assert (tmp_path / "gallery.png").stat().st_size > 1000


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_prior(process="mixed", text=True).save(tmp_path_factory.mktemp("reader"))


@pytest.mark.parametrize("command", ["complete", "rearrange"])
def test_prompts_reach_the_prior(
    inpainting_files: tuple[Path, Path], reader: Path, tmp_path: Path, command: str
) -> None:
    scenes, _ = inpainting_files
    words = [command, f"scenes={scenes}", f"prior={reader}", "num_steps=2", "pictures=0", f"output={tmp_path}"]
    guided = ["guidance=1.5", "claim_guidance=1", "physics_guidance=1"]
    assert main([*words, "prompt=A scene with two cups, a plate and a table.", *guided]) == 0
    prior, before = ScenePrior.load(reader), SceneBatch.load(inpainting_files[0])
    expected = getattr(prior, command)(
        before, prompt="A scene with two cups, a plate and a table.", guidance=1.5, claim_guidance=1.0,
        physics_guidance=1.0, num_steps=2,
    )  # fmt: skip
    assert torch.equal(SceneBatch.load(tmp_path / "scenes.safetensors").tensor, expected.tensor)


@pytest.mark.slow
def test_search_and_post_training_take_prompts(reader: Path, tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    words = ["search", f"prior={reader}", "objective=prompt_match", "prompt=A scene with two cups.", "guidance=1"]
    assert main([*words, "budget=3", "branching=2", "num_steps=2", f"output={tmp_path / 'search'}"]) == 0
    metrics = json.loads((tmp_path / "search" / "metrics.json").read_text())
    config = yaml.safe_load((tmp_path / "search" / "config.yaml").read_text())
    assert config["prompt"] == "A scene with two cups."
    assert metrics["nfe"] == 3 * 2 * 2
    assert 0.0 <= metrics["search"]["objective"] <= 1.0
    words = ["post-train", f"prior={reader}", "reward=prompt_match", "iterations=1", "batch_size=4", "num_steps=2"]
    words += ["regularisation.batch_size=2", "regularisation.bank_size=9", "guard.scenes=4"]
    words += [
        "prompt=[A scene with two cups., A scene with 9 objects.]",
        "algorithm.scenes_per_prompt=2",
        "algorithm.min_std=0.0001",
        "progress=none",
        "logger.report_scenes=0",
    ]
    assert main([*words, f"output={tmp_path / 'run'}"]) == 0
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["prompt"] == ["A scene with two cups.", "A scene with 9 objects."]


@pytest.mark.slow
def test_guidance_without_a_prompt_is_said(
    inpainting_files: tuple[Path, Path], reader: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        ["complete", f"scenes={inpainting_files[0]}", f"prior={reader}"],
        ["rearrange", f"scenes={inpainting_files[0]}", f"prior={reader}"],
        ["sample", f"prior={reader}"],
        ["search", f"prior={reader}"],
        ["post-train", f"prior={reader}"],
    ):
        assert main([*words, "guidance=2", f"output={tmp_path / words[0]}"]) == 2
        message = capsys.readouterr().err
        assert "guidance=2" in message
        assert "prompt" in message


def test_wrong_input_is_said(
    inpainting_files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["complete", f"output={tmp_path}"]) == 2
    assert "scenes=" in capsys.readouterr().err
    _, prior = inpainting_files
    assert main(["sample", f"prior={prior}", "prompt=A scene with 3 objects.", f"output={tmp_path}"]) == 2
    assert "trained without text" in capsys.readouterr().err
    assert main(["import-checkpoint", "only.ckpt", f"output={tmp_path}"]) == 2
    assert "metadata.json" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["complete", "rearrange"])
def test_a_file_without_scenes_is_refused(
    command: str, inpainting_files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SceneBatch.empty("dimsum_table", 2)[:0].save(tmp_path / "none.safetensors")
    none, (_, prior) = tmp_path / "none.safetensors", inpainting_files
    words = [command, f"prior={prior}", f"scenes={none}", f"output={tmp_path / 'out'}"]
    assert main(words) == 2
    assert "holds no scene" in capsys.readouterr().err


def test_a_checkpoint_of_the_authors_becomes_a_prior(tmp_path: Path) -> None:
    checkpoint, metadata = write_checkpoint(tmp_path, random_state())
    words = ["import-checkpoint", str(checkpoint), str(metadata), "scene=dimsum_table", "num_steps=3", "count=2"]
    assert main([*words, f"output={tmp_path / 'run'}"]) == 0
    prior = ScenePrior.load(tmp_path / "run")
    saved = SceneBatch.load(tmp_path / "run" / "scenes.safetensors")
    assert torch.equal(prior.sample(2, num_steps=3, seed=0).tensor, saved.tensor)


@pytest.mark.slow
def test_an_imported_prior_without_geometry_is_sampled_without_physics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    order = [f"their_{name}" for name in get_scene_type("dimsum_table").assets]
    checkpoint, metadata = write_checkpoint(tmp_path, random_state(), order=order)
    imported, output = tmp_path / "imported", tmp_path / "samples"
    assert main(["import-checkpoint", str(checkpoint), str(metadata), "count=0", f"output={imported}"]) == 0
    words = ["sample", f"prior={imported}", "count=2", "num_steps=2", "workers=0", f"output={output}"]
    assert main(words) == 0
    assert "have no geometry here" in capsys.readouterr().out
    assert len(SceneBatch.load(output / "scenes.safetensors")) == 2
    assert not (output / "gallery.png").exists()
    assert "reward" not in json.loads((output / "metrics.json").read_text())
    assert main([*words[:-1], f"output={tmp_path / 'ready'}", "project=true"]) == 2
    assert "have none here" in capsys.readouterr().err
    assert main([*words[:-1], f"output={tmp_path / 'guided'}", "physics_guidance=1"]) == 2
    assert "physics_guidance=1 needs the geometry of the assets" in capsys.readouterr().err


@pytest.mark.slow
def test_a_fresh_scene_is_not_rearranged_into_itself(inpainting_files: tuple[Path, Path], tmp_path: Path) -> None:
    words = ["rearrange", "prior=dimsum_table", "count=1", "num_steps=10", "pictures=0", f"output={tmp_path}"]
    assert main(words) == 0
    assert json.loads((tmp_path / "metrics.json").read_text())["mean_distance_m"] > 0.1


@pytest.mark.slow
def test_scenes_are_completed_in_parts(
    inpainting_files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes, prior = inpainting_files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "num_steps=2", "pictures=0"]
    assert main([*words, f"output={tmp_path / 'whole'}"]) == 0
    monkeypatch.setattr("agents.cli.commands.inpaint._AT_ONCE", 2)
    assert main([*words, f"output={tmp_path / 'parts'}"]) == 0
    whole, parts = (SceneBatch.load(tmp_path / name / "scenes.safetensors").tensor for name in ("whole", "parts"))
    torch.testing.assert_close(parts, whole, rtol=0, atol=1e-5)


def short_search(folder: Path, *words: str) -> dict:
    """The metrics of a search for six scenes of an untrained prior."""
    prior = tiny_prior("dimsum_table", process="mixed", slots=6).save(folder / "prior")
    short = ["objective=object_count", "planner=greedy", "budget=6", "branching=2", "num_steps=2", "slots=6"]
    assert main(["search", f"prior={prior}", *short, *words, f"output={folder / 'found'}"]) == 0
    return metrics(folder / "found")


@pytest.mark.slow
def test_search_and_baseline_have_a_last_line_with_the_scenes_and_evaluations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = short_search(tmp_path)  # progress and result have one unit: the objective
    lines = [line for line in capsys.readouterr().err.splitlines() if " scenes, best " in line]
    assert [line.split(":")[0] for line in lines] == ["search", "best of N"]
    assert all(line.endswith("12 NFE") for line in lines)
    told = [float(line.split("best ")[-1].split(",")[0]) for line in lines]
    assert told == [found["search"]["objective"], found["best_of"]["objective"]]
    assert max(told) > 1


@pytest.mark.slow
def test_a_baseline_that_would_take_longer_than_the_limit_is_left_out_and_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "best_of" not in short_search(tmp_path, "max_seconds=1e-6")
    assert "the baseline, as many independent samples, is left out" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["sample reward", "search objective", "post-train reward", "doctor reward"])
def test_a_reward_that_needs_prompts_is_refused_before_anything_is_sampled(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    prior = tiny_prior("dimsum_table", process="mixed", text=True).save(tmp_path / "prior")
    name, key = command.split()
    nested = "{name: weighted_sum, rewards: [object_count, prompt_match]}"
    assert main([name, f"prior={prior}", f"{key}={nested}", f"output={tmp_path / 'run'}"]) == 2
    said = capsys.readouterr()
    assert "has no prompt to compare with: give prompt=" in said.err
    assert "scenes in" not in said.out
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_a_sample_says_how_many_claims_of_its_prompt_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    prior = tiny_prior("dimsum_table", process="mixed", text=True).save(tmp_path / "prior")
    words = [f"prior={prior}", "count=2", "num_steps=2", "pictures=0", "reward=prompt_match"]
    run = tmp_path / "counted"
    assert main(["sample", *words, "prompt=A scene with 12 objects.", f"output={run}"]) == 0
    found, counts = metrics(run), SceneBatch.load(run / "scenes.safetensors").counts
    held = float((counts == 12).double().mean())
    assert found["prompt"] == {"claims_hold": held, "all_claims_hold": held}
    ratio = (torch.minimum(counts, torch.tensor(12)) / torch.maximum(counts, torch.tensor(12))).double().mean()
    assert found["reward"]["mean"] == pytest.approx(
        float(ratio), abs=1e-6
    )  # the reward reads the prompt of the samples
    assert f"prompt: {held:.0%} of the claims hold" in capsys.readouterr().out
    assert main(["sample", *words[:-1], "prompt=a table", "claim_guidance=2", f"output={tmp_path / 'free'}"]) == 0
    said = capsys.readouterr()
    assert "expected 'A scene with …' or 'A scene where …'. claim_guidance does nothing for this prompt" in said.err
    assert "prompt" not in metrics(tmp_path / "free")
