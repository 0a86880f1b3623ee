"""Assets from MJCF and USD: our exports come back, other files agree with MuJoCo and closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch

from scene_envs import SceneBatch
from scene_envs.assets import Asset, import_report, load_library
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.export import export
from scene_envs.scene_types import get_scene_type


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))


def listed(folder: Path, name: str, text: str | None = None, keys: str = "") -> Asset:
    if text is not None:
        (folder / name).write_text(text)
    (folder / "library.yaml").write_text(f"- {{file: '{name}', name: it{keys}}}")
    return load_library(folder)[0]


def said(folder: Path) -> str:
    return str(import_report(folder)["it"])


def exported(folder: Path, form: str) -> dict[str, Asset]:
    """Our assets by name, exported with a scene that holds one of each."""
    kind = get_scene_type("dimsum_table")
    count = 5
    poses = torch.zeros(1, count, 3), torch.eye(3).expand(1, count, 3, 3).clone()
    export(SceneBatch.from_parts(*poses, torch.arange(count)[None], kind), folder, form)
    return {asset.name: asset for asset in list(kind.library)[:count]}


def assert_same(found: Asset, given: Asset) -> None:
    assert found.static == given.static
    if not given.static:
        assert found.mass == pytest.approx(given.mass, rel=1e-6)
        np.testing.assert_allclose(found.center_of_mass, given.center_of_mass, atol=1e-6)
        np.testing.assert_allclose(found.inertia, given.inertia, atol=1e-6 * np.trace(given.inertia))
    assert len(found.fine) == len(given.fine)
    for mine, theirs in zip(found.fine, given.fine, strict=True):
        gaps = np.linalg.norm(mine.vertices[:, None] - theirs.vertices, axis=2)
        assert gaps.min(axis=0).max() < 1e-6  # each corner is there
        assert gaps.min(axis=1).max() < 1e-6  # and no other
    np.testing.assert_allclose(found.visual.bounds, given.visual.bounds, atol=1e-6)


def test_our_mjcf_comes_back(tmp_path: Path) -> None:
    ours = exported(tmp_path / "out", "mjcf")
    scene = tmp_path / "out" / "scene_000" / "scene.xml"
    for name, asset in ours.items():
        tree = ElementTree.parse(scene)
        world = tree.getroot().find("worldbody")
        for body in world.findall("body"):
            if not body.get("name").startswith(name):
                world.remove(body)
        tree.write(scene.parent / "it.xml")
        assert_same(listed(scene.parent, "it.xml", keys=", base: origin"), asset)


CABINET = """<mujoco><worldbody><light/><geom name="floor" type="plane" size="1 1 .1"/><body name="cabinet" pos="0 0 1">
<freejoint/><geom type="box" size=".1 .2 .3" mass="2" friction=".5 .1 .1" rgba="1 0 0 1"/><geom type="sphere" size=".1"
contype="0" conaffinity="0" mass="0"/><body name="door" pos=".2 0 0"><joint name="hinge" range="0 90"/>
<geom type="cylinder" size=".05 .2" density="100"/></body></body></worldbody></mujoco>"""


def test_a_cabinet_is_one_body_as_mujoco_weighs_it(tmp_path: Path) -> None:
    asset = listed(tmp_path, "it.xml", CABINET, ", base: origin")
    door = 100 * np.pi * 0.05**2 * 0.4
    assert asset.mass == pytest.approx(2 + door)
    np.testing.assert_allclose(asset.center_of_mass, [0.2 * door / (2 + door), 0, 0], atol=1e-9)
    spec = mujoco.MjSpec.from_string(CABINET.replace('<joint name="hinge" range="0 90"/>', ""))
    spec.compiler.fusestatic = True
    model: Any = spec.compile()
    moments = np.sort(model.body_inertia[1])
    np.testing.assert_allclose(np.linalg.eigvalsh(asset.inertia), moments, rtol=1e-9)
    assert not asset.static
    assert len(asset.fine) == 2
    for words in ("movable joints frozen at zero: hinge", "'floor' of the world is left out", "friction of geoms"):
        assert words in said(tmp_path)
    fixed = listed(tmp_path, "it.xml", CABINET.replace("<freejoint/>", ""))
    assert fixed.static
    assert "no free joint: it is welded" in said(tmp_path)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("<mujoco><worldbody/></mujoco>", InvalidInputError, "holds no <body>"),
        ("<mujoco><worldbody><body name='a'><geom size='1'/></body><body name='b'><geom size='1'/></body></worldbody>"
         "</mujoco>", InvalidInputError, "2 bodies"),
        ("<mujoco><worldbody><geom type='mesh' mesh='lost'/></worldbody></mujoco>", CorruptFileError, "lost"),
        ("<package/>", CorruptFileError, "cannot be read as MJCF"),
    ],
)  # fmt: skip
def test_mjcf_that_is_no_asset_is_refused(tmp_path: Path, text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        listed(tmp_path, "it.xml", text)
