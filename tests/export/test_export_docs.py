"""The code that docs/export.md shows runs as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from export_scenes import laid_scene

from scene_envs.export import export, formats

PAGE = Path(__file__).parents[2] / "docs" / "export.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
NEEDS = ("mujoco", "pydrake", "pybullet", "pxr")


def test_the_page_shows_every_target():
    text = "".join(BLOCKS)
    assert all(f"import {name}" in text or f"from {name}" in text for name in (*NEEDS, "numpy"))


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.split("\n")[0].replace(" ", "_"))
def test_code_blocks_run(block, tmp_path, monkeypatch):
    for name in NEEDS:
        if f"import {name}" in block or f"from {name}" in block or (name == "pxr" and '"usd"' in block):
            pytest.importorskip(name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(formats, "_FORMATS", dict(formats._FORMATS))
    if "SceneBatch" not in block:
        signs = [("scene.xml", "mjcf"), ("dmd", "drake"), ("objects.json", "urdf"), ("usda", "usd"), ("npz", "npz")]
        export(laid_scene(), "scenes", [name for sign, name in signs if sign in block] or ["npz"])
    exec(block, {"__name__": "docs"})
