"""The folders that pages of the documentation speak of, very small."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import trimesh

from agents.priors.testing import tiny_prior
from scene_envs.datasets import generate


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``data/`` with two datasets, ``runs/`` with priors and scenes, ``my_assets/`` with a model."""
    folder = tmp_path_factory.mktemp("pages")
    for name in ("dimsum_table", "pantry_shelf"):
        generate(name, 12, folder / "data" / name, workers=0, verify=False, progress=False)
    tiny_prior(process="mixed", text=True).save(folder / "runs" / "mixed")
    tiny_prior().save(folder / "runs" / "clutter")
    (folder / "runs" / "mine").mkdir()
    tiny_prior().sample(2, num_steps=2).save(folder / "runs" / "mine" / "scenes.safetensors")
    (folder / "my_assets").mkdir()
    trimesh.creation.box((0.06, 0.06, 0.04)).export(folder / "my_assets" / "brick.obj")
    return folder


@pytest.fixture
def stage(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of those folders, as working directory."""
    folder = tmp_path / "stage"
    shutil.copytree(made, folder)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path / "cache"))
    return folder
