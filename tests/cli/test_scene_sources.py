"""Scene sources: one meaning of ``scenes=`` in every command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs.datasets import load_scenes
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch

pytestmark = pytest.mark.usefixtures("blank_curves")

OWN_WORDS = {
    "project": ["workers=0", "pictures=0"],
    "view": ["pictures=0"],
    "render": ["modes=[instance]"],
    "export": ["formats=npz", "workers=0"],
    "complete": ["num_steps=2", "pictures=0"],
    "rearrange": ["num_steps=2", "pictures=0"],
    "search": ["objective=object_count", "budget=2", "branching=2", "num_steps=2", "baseline=false"],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scene files, a.safetensors of 2 scenes and b.safetensors of 1 with more slots, and a prior."""
    folder = tmp_path_factory.mktemp("sources")
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    scenes[:2].save(folder / "files" / "a.safetensors")
    scenes[2:].with_slots(40).save(folder / "files" / "b.safetensors")
    tiny_prior().save(folder / "trained" / "prior")
    return folder


def test_a_folder_of_scene_files_is_all_of_their_scenes(folder: Path) -> None:
    batch = load_scenes(folder / "files")
    assert batch.tensor.shape[:2] == (3, 40)
    first = SceneBatch.load(folder / "files" / "a.safetensors")
    assert torch.equal(batch.with_slots(40)[:2].counts, first.counts)
    assert len(load_scenes(folder / "files", 2)) == 2
    other = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 1)
    other.save(folder / "mixed" / "a.safetensors")
    first.save(folder / "mixed" / "b.safetensors")
    with pytest.raises(InvalidInputError, match="several scene types, dimsum_table, pantry_shelf"):
        load_scenes(folder / "mixed")


@pytest.mark.slow
@pytest.mark.parametrize("command", OWN_WORDS)
def test_every_command_takes_a_folder_of_scene_files(
    folder: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    prior = [f"prior={folder / 'trained'}"] if command in ("complete", "rearrange", "search") else []
    words = [command, *prior, *OWN_WORDS[command], "count=3"]
    assert main([*words, f"scenes={folder / 'files'}", f"output={tmp_path / 'out'}"]) == 0
    made = {"project": "ready", "complete": "scenes", "rearrange": "scenes", "search": "best"}
    if command in made:
        assert len(SceneBatch.load(tmp_path / "out" / f"{made[command]}.safetensors")) == 3
    assert main([*words, f"scenes={folder / 'trained'}", f"output={tmp_path / 'none'}"]) == 2
    assert "holds a prior and no scenes; draw some" in capsys.readouterr().err
