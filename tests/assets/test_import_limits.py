"""Limits on the size of a user's model file and on the time of its import."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from scene_envs.assets import import_report, load_library
from scene_envs.assets.importing import solids as decomposition
from scene_envs.assets.importing import user_library
from scene_envs.assets.importing.limits import READ_HERE
from scene_envs.errors import InvalidInputError, SceneEnvsError


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))


def listed(folder: Path, name: str) -> Path:
    (folder / "library.yaml").write_text(f"- {{file: {name}}}")
    return folder / name


def refused(folder: Path, words: str) -> str:
    with pytest.raises(InvalidInputError, match=words) as told:
        load_library(folder)
    return str(told.value)


@pytest.mark.parametrize("name", ["large.obj", "large.stl", "large.urdf", "large.sdf"])
def test_a_file_of_two_gigabytes_is_refused_unread(tmp_path: Path, name: str) -> None:
    with listed(tmp_path, name).open("wb") as file:
        file.write(b"x")
        file.truncate(2_000_000_000)  # a hole on the disk
    text = refused(tmp_path, "2,000 MB, more than the 256 MB .* SCENE_ENVS_IMPORT_MEGABYTES")
    assert name in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("many.ply", b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face 50000000\nend_header\n"),
        ("many.off", b"OFF\n# a comment\n3 50000000 0\n0 0 0\n"),
        ("many.stl", bytes(80) + struct.pack("<I", 50_000_000) + bytes(100)),
        ("many.gltf", json.dumps({"asset": {"version": "2.0"}, "accessors": [{"count": 150_000_000}]}).encode()),
    ],
)
def test_a_header_of_fifty_million_faces_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    listed(tmp_path, name).write_bytes(content)
    assert name in refused(tmp_path, "50,000,000 triangles, more than the 1,000,000 .* SCENE_ENVS_IMPORT_TRIANGLES")


def test_faces_of_an_obj_are_counted_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(listed(tmp_path, "box.obj"))
    monkeypatch.setenv("SCENE_ENVS_IMPORT_TRIANGLES", "11")
    assert "box.obj has 12 triangles" in refused(tmp_path, "more than the 11 ")
    monkeypatch.setenv("SCENE_ENVS_IMPORT_TRIANGLES", "12")
    assert load_library(tmp_path).names == ("box",)


@pytest.mark.filterwarnings("ignore:Image size")  # Pillow's own limit is higher
@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_a_small_file_with_a_huge_texture_is_refused_before_it_is_decoded(tmp_path: Path, kind: str) -> None:
    texture = Image.new("1", (8_200, 8_200))  # 9 kB on the disk, 270 MB as colours
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    if kind == "glb":
        small = TextureVisuals(uv=np.zeros((8, 2)), material=PBRMaterial(baseColorTexture=texture))
        trimesh.Trimesh(box.vertices, box.faces, visual=small, process=False).export(listed(tmp_path, "box.glb"))
    else:
        texture.save(tmp_path / "huge.png")
        (tmp_path / "box.mtl").write_text("newmtl skin\nmap_Kd huge.png\n")
        corners = "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices.tolist())
        faces = "".join(f"f {a + 1}/1 {b + 1}/1 {c + 1}/1\n" for a, b, c in box.faces.tolist())
        listed(tmp_path, "box.obj").write_text(f"mtllib box.mtl\n{corners}vt 0 0\nusemtl skin\n{faces}")
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < READ_HERE
    text = refused(tmp_path, "a texture of 8,200 x 8,200 pixels, more than the 67,108,864")
    assert f"box.{kind}" in text


def test_without_a_list_a_file_beyond_the_limits_is_left_out_and_told(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "box.obj")
    (tmp_path / "many.off").write_bytes(b"OFF\n3 50000000 0\n0 0 0\n")
    assert load_library(tmp_path).names == ("box",)
    assert "50,000,000 triangles" in import_report(tmp_path)["many"].error


@pytest.mark.slow
def test_coacd_is_ended_when_the_time_of_the_file_is_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("coacd")
    torus = trimesh.creation.torus(0.1, 0.04, 60, 30)
    torus.vertices += 0.002 * np.sin(90 * torus.vertices[:, ::-1])
    torus.export(listed(tmp_path, "knotty.stl"))
    monkeypatch.setenv("SCENE_ENVS_IMPORT_SECONDS", "1")
    monkeypatch.setitem(decomposition.COACD_SETTINGS, "mcts_iterations", 10**6)
    text = refused(tmp_path, "took longer than 1 s, CoACD decomposing .*`decomposition: convex`.*IMPORT_SECONDS")
    assert "knotty.stl" in text


def sphere(folder: Path, name: str, subdivisions: int) -> Path:
    path = listed(folder, name)
    trimesh.creation.icosphere(subdivisions, 0.1).export(path)
    return path


@pytest.mark.usefixtures("new_interpreters")
def test_a_stage_is_ended_when_the_time_of_the_file_is_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = sphere(tmp_path, "sphere.stl", 5)
    assert path.stat().st_size > READ_HERE
    # A stage that never ends, in the process of the import: the module that Python imports first there.
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep(1000)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("SCENE_ENVS_IMPORT_SECONDS", "1")
    text = refused(tmp_path, r"sphere.stl: the import took longer than 1 s; .*SCENE_ENVS_IMPORT_SECONDS")
    assert "\n" not in text


def test_a_small_file_that_never_ends_is_ended_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    listed(tmp_path, "box.obj").write_text(f"mtllib pipe.mtl\n{corners}usemtl a\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 1 3 4\n")
    pipe = tmp_path / "pipe.mtl"
    os.mkfifo(pipe)  # whoever reads it waits for somebody who writes
    monkeypatch.setenv("SCENE_ENVS_IMPORT_SECONDS", "1")
    try:
        text = refused(tmp_path, r"box\.obj: the import took longer than 1 s; .*SCENE_ENVS_IMPORT_SECONDS")
    finally:
        os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))  # the reader that was left reads its end
    assert "\n" not in text


@pytest.mark.usefixtures("new_interpreters")
def test_a_process_of_an_import_that_crashes_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sphere(tmp_path, "sphere.stl", 5)
    (tmp_path / "sitecustomize.py").write_text("import os\nos._exit(7)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    refused(tmp_path, "sphere.stl: the import ended its process .exit status 7. without an answer; simplify the file")


@pytest.mark.slow
def test_a_large_file_is_imported_as_a_small_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sphere(tmp_path, "sphere.stl", 3)
    monkeypatch.setattr(user_library, "READ_HERE", 10_000)
    apart, report = load_library(tmp_path).assets[0], import_report(tmp_path)["sphere"]
    monkeypatch.setattr(user_library, "READ_HERE", 10**9)
    user_library._built.cache_clear()
    here = load_library(tmp_path).assets[0]
    assert apart is not here
    assert (apart.mass, len(apart.fine)) == (here.mass, len(here.fine))
    for name in ("inertia", "center_of_mass"):
        np.testing.assert_array_equal(getattr(apart, name), getattr(here, name))
    np.testing.assert_array_equal(apart.visual.vertices, here.visual.vertices)
    np.testing.assert_array_equal(apart.fine[0].vertices, here.fine[0].vertices)
    assert str(report) == str(import_report(tmp_path)["sphere"])
    broken = tmp_path / "broken"
    broken.mkdir()
    listed(broken, "noise.stl").write_bytes(bytes(80) + struct.pack("<I", 10_000) + bytes(400_000))
    monkeypatch.undo()
    with pytest.raises(SceneEnvsError, match=r"noise\.stl"):
        load_library(broken)


@pytest.mark.parametrize("text", ["a lot", "0", "-1", "nan"])
def test_a_limit_that_is_no_positive_number_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(listed(tmp_path, "box.obj"))
    monkeypatch.setenv("SCENE_ENVS_IMPORT_MEGABYTES", text)
    refused(tmp_path, "SCENE_ENVS_IMPORT_MEGABYTES=.* must be a positive number")
