"""Commands that change scenes with a prior, and the import of checkpoints."""

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
from agents.utils.seeds import derived_seed
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type
from tests.helpers.authors_flux import random_state, write_checkpoint


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("inpainting")
    tiny_prior(process="mixed").save(folder / "prior")
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    return scenes.save(folder / "scenes.safetensors"), folder / "prior"


def test_complete_adds_and_keeps(files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "slots=40", "num_steps=3", "pictures=0", "count=2"]
    assert main([*words, f"output={tmp_path}"]) == 0
    before, after = SceneBatch.load(scenes)[:2], SceneBatch.load(tmp_path / "scenes.safetensors")
    assert after.tensor.shape == (2, 40, 20)
    present = ~before.is_empty
    assert (after.tensor[:, :34][present] == before.tensor[present]).all()
    assert json.loads((tmp_path / "metrics.json").read_text())["added"] >= 0


def test_complete_adds_no_more_than_fill(files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "fill=2", "num_steps=3", "pictures=0"]
    assert main([*words, f"output={tmp_path}"]) == 0
    before, after = SceneBatch.load(scenes), SceneBatch.load(tmp_path / "scenes.safetensors")
    assert bool((after.counts - before.counts <= 2).all())
    assert bool((after.counts > before.counts).any())
    assert main([*words, "fill=-1", f"output={tmp_path / 'wrong'}"]) == 2


@pytest.mark.parametrize("command", ["complete", "rearrange"])
def test_fresh_samples_are_inpainted(files: tuple[Path, Path], tmp_path: Path, command: str) -> None:
    _, prior = files
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
def test_rearrange_moves_and_keeps_what_there_is(files: tuple[Path, Path], tmp_path: Path) -> None:
    scenes, prior = files
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
def test_prompts_reach_the_prior(files: tuple[Path, Path], reader: Path, tmp_path: Path, command: str) -> None:
    words = [command, f"scenes={files[0]}", f"prior={reader}", "num_steps=2", "pictures=0", f"output={tmp_path}"]
    guided = ["guidance=1.5", "claim_guidance=1", "physics_guidance=1"]
    assert main([*words, "prompt=A scene with two cups, a plate and a table.", *guided]) == 0
    prior, before = ScenePrior.load(reader), SceneBatch.load(files[0])
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
    files: tuple[Path, Path], reader: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (
        ["complete", f"scenes={files[0]}", f"prior={reader}"],
        ["rearrange", f"scenes={files[0]}", f"prior={reader}"],
        ["sample", f"prior={reader}"],
        ["search", f"prior={reader}"],
        ["post-train", f"prior={reader}"],
    ):
        assert main([*words, "guidance=2", f"output={tmp_path / words[0]}"]) == 2
        message = capsys.readouterr().err
        assert "guidance=2" in message
        assert "prompt" in message


def test_wrong_input_is_said(files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["complete", f"output={tmp_path}"]) == 2
    assert "scenes=" in capsys.readouterr().err
    _, prior = files
    assert main(["sample", f"prior={prior}", "prompt=A scene with 3 objects.", f"output={tmp_path}"]) == 2
    assert "trained without text" in capsys.readouterr().err
    assert main(["import-checkpoint", "only.ckpt", f"output={tmp_path}"]) == 2
    assert "metadata.json" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["complete", "rearrange"])
def test_a_file_without_scenes_is_refused(
    command: str, files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SceneBatch.empty("dimsum_table", 2)[:0].save(tmp_path / "none.safetensors")
    words = [command, f"prior={files[1]}", f"scenes={tmp_path / 'none.safetensors'}", f"output={tmp_path / 'out'}"]
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
def test_a_fresh_scene_is_not_rearranged_into_itself(files: tuple[Path, Path], tmp_path: Path) -> None:
    words = ["rearrange", "prior=dimsum_table", "count=1", "num_steps=10", "pictures=0", f"output={tmp_path}"]
    assert main(words) == 0
    assert json.loads((tmp_path / "metrics.json").read_text())["mean_distance_m"] > 0.1


@pytest.mark.slow
def test_scenes_are_completed_in_parts(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes, prior = files
    words = ["complete", f"scenes={scenes}", f"prior={prior}", "num_steps=2", "pictures=0"]
    assert main([*words, f"output={tmp_path / 'whole'}"]) == 0
    monkeypatch.setattr("agents.cli.commands.inpaint._AT_ONCE", 2)
    assert main([*words, f"output={tmp_path / 'parts'}"]) == 0
    whole, parts = (SceneBatch.load(tmp_path / name / "scenes.safetensors").tensor for name in ("whole", "parts"))
    torch.testing.assert_close(parts, whole, rtol=0, atol=1e-5)
