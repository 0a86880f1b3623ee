"""Folders that pages of the documentation speak of, very small: datasets, priors, scenes, models of assets."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import trimesh

from agents import cli
from agents.priors.testing import tiny_prior
from scene_envs.datasets import generate
from tests.helpers.authors_flux import random_state, write_checkpoint
from tests.helpers.small_bert import write_bert

_URDF = """<robot name="mug"><link name="mug"><inertial><mass value="0.2"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><box size="0.06 0.06 0.08"/></geometry></visual>
<collision><geometry><box size="0.06 0.06 0.08"/></geometry></collision></link></robot>"""
_SDF = """<sdf version="1.9"><model name="shelf"><link name="shelf">
<visual name="board"><geometry><box><size>0.6 0.2 0.02</size></box></geometry></visual>
<collision name="board"><geometry><box><size>0.6 0.2 0.02</size></box></geometry></collision></link></model></sdf>"""


def prepare(name: str) -> None:
    """Make the folder or file ``name`` below the working directory, unless it is there."""
    target = Path(name)
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        _RECIPES[name](target)


def _dataset(scene_type: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        generate(scene_type, 24, folder, workers=0, verify=False, progress=False)

    return make


def _prior(scene_type: str = "dimsum_table", *, text: bool = False) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        tiny_prior(scene_type, process="mixed" if text else "continuous", text=text).save(folder)

    return make


def _scenes(folder: Path) -> None:
    folder.mkdir()
    tiny_prior().sample(2, num_steps=2).save(folder / "scenes.safetensors")


def _models(folder: Path) -> None:
    (folder / "meshes").mkdir(parents=True)
    (folder / "shelf").mkdir()
    (folder / "mug.urdf").write_text(_URDF)
    (folder / "shelf" / "model.sdf").write_text(_SDF)
    trimesh.creation.box((60, 60, 40)).export(folder / "meshes" / "box.stl")


def _bert(folder: Path) -> None:
    write_bert(folder, longest=128)


def _config(file: Path) -> None:
    with redirect_stdout(StringIO()) as printed:
        assert cli.main(["post-train", "reward=object_count", "--cfg", "job"]) == 0
    file.write_text(printed.getvalue())


def _checkpoint(file: Path) -> None:
    written, _ = write_checkpoint(file.parent, random_state(text=0))
    shutil.move(written, file)


_RECIPES: dict[str, Callable[[Path], None]] = {
    "data/dimsum_table": _dataset("dimsum_table"),
    "data/dimsum_small": _dataset("dimsum_table"),
    "data/living_room_shelf": _dataset("living_room_shelf"),
    "data/pantry_shelf": _dataset("pantry_shelf"),
    "runs/mixed": _prior(text=True),
    "runs/clutter/config.yaml": _config,
    "runs/mine": _scenes,
    "runs/tea_table": _prior("tea_table"),
    "models/bert-base": _bert,
    "FILE.ckpt": _checkpoint,
    "my_assets": _models,
}
"""How each is made, from its name on the pages."""
