"""The folder an export leaves: layout, names, precision, errors, own formats, and the command."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from agents.cli import main
from agents.priors import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.assets.base import identifiers
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError, MissingDependencyError, UnknownNameError
from scene_envs.export import AssetFiles, export, formats, list_formats, register_format
from scene_envs.export.placed import (
    angle_axis,
    exact_rotations,
    face_colors,
    quaternion,
    textured_mesh,
    visual_mesh,
)
from scene_envs.export.urdf import roll_pitch_yaw
from scene_envs.normalizer import Normalizer
from scene_envs.physics.parts import PartGeometry
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import DIMSUM, all_scenes, jittered_scene, laid_scene

TEXT = ("urdf", "sdf", "drake", "mjcf")


def content(folder) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


# -- layout ------------------------------------------------------------------------------------------


def test_each_scene_has_a_folder_and_assets_are_shared(folder, batch):
    names = {path.name for path in folder.iterdir()}
    assert names >= {"assets", "export.json", "package.xml", "scene_000", "scene_003"}
    assert len([path for path in folder.glob("scene_*") if path.is_dir()]) == len(batch)
    used = {name for row in batch.names() for name in row}
    assert {path.name for path in (folder / "assets").iterdir()} == used
    expected = {"objects.json", "world.sdf", "scene.dmd.yaml", "scene.xml", "scene.glb", "scene.npz"}
    assert expected <= {path.name for path in (folder / "scene_000").iterdir()}
    parts = sorted((folder / "assets" / "teacup").glob("part_*.obj"))
    assert len(parts) == len(DIMSUM.library["teacup"].fine)


def test_no_file_names_a_place_outside_the_folder(folder):
    for name, data in content(folder).items():
        assert b"written here" not in data, name
        for target in re.findall(rb'(?:filename|file|urdf|uri)["=:> ]+([^"<]+)', data) if name[-3:] != "glb" else ():
            assert not target.startswith(b"/"), name


def test_a_package_of_the_user_keeps_its_name_and_one_without_a_name_is_refused(tmp_path, batch):
    package = tmp_path / "package.xml"
    package.write_text("<package><name>kitchen</name></package>")
    export(batch[:1], tmp_path, formats=["drake"])
    assert "package://kitchen/" in (tmp_path / "scene_000" / "scene.dmd.yaml").read_text()
    package.write_text("<package/>")
    with pytest.raises(InvalidInputError, match=r"package.xml has no <name>.*name the package there"):
        export(batch[:1], tmp_path, formats=["drake"])
    assert package.read_text() == "<package/>"


def test_duplicates_have_names_of_their_own(scenes):
    names = [thing.name for thing in scenes[0].objects]
    assert len(set(names)) == len(names)
    assert {"teacup_0", "teacup_1", "cafe_table_0"} <= set(names)
    assert [thing.name for thing in scenes[0].objects if thing.welded] == ["cafe_table_0"]


def test_parts_are_the_librarys_and_bullets_are_a_millimetre_smaller(folder):
    files = folder / "assets" / "teapot"
    for index, part in enumerate(DIMSUM.library["teapot"].fine):
        exact = trimesh.load(files / f"part_{index:02d}.obj", process=False)
        np.testing.assert_allclose(exact.vertices, part.vertices, atol=1e-12)
        assert exact.is_watertight
        assert exact.volume > 0
        inset = trimesh.load(files / f"inset_{index:02d}.obj", process=False)
        gaps = PartGeometry.of(part).offsets[:, None] - PartGeometry.of(part).normals @ inset.vertices.T
        np.testing.assert_allclose(gaps.min(axis=1), 1e-3, atol=1e-9)


def test_visual_meshes_keep_their_shape_and_colours(folder):
    asset = DIMSUM.library["teapot"]
    mesh = trimesh.load(folder / "assets" / "teapot" / "visual.obj", process=False, maintain_order=True)
    np.testing.assert_allclose(mesh.bounds, asset.visual.bounds, atol=1e-6)
    palette = np.asarray(mesh.visual.material.image)
    assert {tuple(rgb) for rgb in palette.reshape(-1, 3).tolist()} - {(0, 0, 0)} == {
        tuple(rgb) for rgb in np.unique(asset.visual.visual.face_colors[:, :3], axis=0).tolist()
    }
    shown = np.asarray(mesh.visual.to_color().vertex_colors)[mesh.faces][:, 0, :3]
    np.testing.assert_array_equal(shown, asset.visual.visual.face_colors[:, :3])


def test_text_formats_are_well_formed_and_small(folder):
    for path in [*folder.rglob("*.sdf"), *folder.rglob("*.urdf"), *folder.rglob("*.xml")]:
        ET.parse(path)
    one = sum(path.stat().st_size for path in (folder / "scene_000").iterdir())
    assert one < 1e6
    assert sum(path.stat().st_size for path in (folder / "assets").rglob("*") if path.is_file()) < 4e6


# -- precision ---------------------------------------------------------------------------------------


def test_rotations_become_exact_without_moving():
    truth = Rotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    single = truth.astype(np.float32)
    exact = exact_rotations(single)
    error = exact.swapaxes(-1, -2) @ exact - np.eye(3)
    assert np.abs(error).max() < 1e-15
    assert np.abs(exact - single).max() < 2e-7
    np.testing.assert_allclose(np.linalg.det(exact), 1.0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 0.5, np.pi / 2, np.pi - 1e-8, np.pi])
def test_angle_axis_and_quaternion_are_exact_at_every_angle(angle):
    for axis in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.6, -0.48, 0.64], [-0.6, 0.8, 0.0]):
        rotation = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        degrees, direction = angle_axis(rotation)
        back = Rotation.from_rotvec(np.radians(degrees) * direction).as_matrix()
        np.testing.assert_allclose(back, rotation, atol=1e-14)
        back = Rotation.from_quat(quaternion(rotation), scalar_first=True).as_matrix()
        np.testing.assert_allclose(back, rotation, atol=1e-14)


@pytest.mark.parametrize("pitch", [0.0, 1e-9, 0.5, np.pi / 2 - 1e-8, np.pi / 2, -np.pi / 2, np.pi])
def test_roll_pitch_and_yaw_are_exact_at_every_angle(pitch):
    for roll, yaw in [(0.0, 0.0), (2.0, -3.0), (np.pi, 1e-9)]:
        rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        back = Rotation.from_euler("xyz", roll_pitch_yaw(rotation)).as_matrix()
        np.testing.assert_allclose(back, rotation, atol=1e-14)


@pytest.mark.slow
def test_pybullet_reads_the_rotations_of_an_sdf_world(folder, scenes):
    pybullet = pytest.importorskip("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    try:
        bodies = pybullet.loadSDF(str(folder / "scene_000" / "world.sdf"), physicsClientId=client)
        assert len(bodies) == len(scenes[0].objects)
        found = []
        for body in bodies:
            at, turn = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
            inertial = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
            back = pybullet.invertTransform(inertial[3], inertial[4])
            at, turn = pybullet.multiplyTransforms(at, turn, *back)
            found.append((np.array(at), Rotation.from_quat(turn).as_matrix()))
    finally:
        pybullet.disconnect(client)
    for thing, (at, turn) in zip(scenes[0].objects, found, strict=True):
        np.testing.assert_allclose(turn, thing.rotation, atol=1e-6, err_msg=thing.name)
        np.testing.assert_allclose(at, thing.translation, atol=1e-6, err_msg=thing.name)


@pytest.mark.slow
def test_translations_are_written_to_the_last_bit(folder, scenes):
    text = (folder / "scene_003" / "scene.xml").read_text()
    for thing in scenes[3].objects:
        found = re.search(rf'<body name="{thing.name}" pos="([^"]*)"', text)
        assert [float(x) for x in found[1].split()] == thing.translation.tolist()


# -- calls -------------------------------------------------------------------------------------------


def test_the_report_says_what_was_written(tmp_path):
    report = export(laid_scene(), tmp_path / "out", ["mjcf", "npz", "mjcf"])
    assert report.formats == ("mjcf", "npz")
    assert report.scenes[0]["mjcf"] == tmp_path / "out" / "scene_000" / "scene.xml"
    assert all(path.is_file() for path in report.scenes[0].values())
    assert set(report.assets) == set(laid_scene().names()[0])
    written = sum(len(data) for name, data in content(tmp_path / "out").items() if name != "export.json")
    assert report.size == written


def test_formats_can_be_added_and_the_same_call_changes_nothing(tmp_path):
    added = ["drake", "mjcf", "sdf"]
    (tmp_path / "notes.txt").write_text("mine")
    export(laid_scene(), tmp_path, "mjcf")
    export(laid_scene(), tmp_path, added)
    before = content(tmp_path)
    export(laid_scene(), tmp_path, added)
    assert content(tmp_path) == before
    assert before["notes.txt"] == b"mine"
    assert json.loads(before["export.json"])["formats"] == added


def test_an_interrupted_export_goes_on(tmp_path, monkeypatch):
    def fail(scene, files, folder):
        raise OSError("No space left on device")

    monkeypatch.setitem(formats._FORMATS, "npz", formats.ExportFormat("npz", "", fail))
    with pytest.raises(OSError, match="No space"):
        export(laid_scene(), tmp_path / "out", ["mjcf", "npz"])
    monkeypatch.undo()
    export(laid_scene(), tmp_path / "out", ["mjcf", "npz"])
    assert (tmp_path / "out" / "scene_000" / "scene.npz").exists()


def test_other_scenes_are_not_overwritten(tmp_path):
    export(laid_scene(), tmp_path / "one", "npz")
    other = laid_scene()
    other = other.with_poses(other.translations + 0.01, other.rotations)
    with pytest.raises(InvalidInputError, match="export of other scenes"):
        export(other, tmp_path / "one", "npz")
    with pytest.raises(InvalidInputError, match=r"export of these scenes with friction=0.6, not 0.9"):
        export(laid_scene(), tmp_path / "one", "npz", friction=0.9)
    (tmp_path / "two" / "assets").mkdir(parents=True)
    with pytest.raises(InvalidInputError, match="already holds 'assets'"):
        export(laid_scene(), tmp_path / "two", "npz")
    (tmp_path / "three").write_text("")
    with pytest.raises(InvalidInputError, match="is a file"):
        export(laid_scene(), tmp_path / "three", "npz")


def test_wrong_input_is_named(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean 'mjcf'"):
        export(laid_scene(), tmp_path / "out", ["mjfc"])
    with pytest.raises(InvalidInputError, match="formats is empty"):
        export(laid_scene(), tmp_path / "out", [])
    with pytest.raises(InvalidInputError, match="friction"):
        export(laid_scene(), tmp_path / "out", friction=float("nan"))
    tensor = laid_scene().tensor.clone()
    tensor[0, 3, 3:12] *= 1.1
    with pytest.raises(InvalidInputError, match="scene 0, slot 3"):
        export(SceneBatch(tensor, DIMSUM), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_only_usd_needs_a_package_and_says_which(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(formats, "find_spec", lambda name: None if name == "pxr" else find(name))
    with pytest.raises(MissingDependencyError, match="pip install usd-core"):
        export(laid_scene(), tmp_path / "out", "usd")
    assert not (tmp_path / "out").exists()
    report = export(laid_scene(), tmp_path / "out")
    assert set(report.formats) == {*TEXT, "glb", "npz"}


def test_writing_needs_no_simulator(tmp_path, monkeypatch):
    for name in ("pybullet", "mujoco", "pydrake", "pxr"):
        monkeypatch.setitem(sys.modules, name, None)  # importing it fails
    export(laid_scene(), tmp_path / "out", [*TEXT, "glb", "npz"])


def test_no_scenes_and_empty_scenes_are_fine(tmp_path):
    assert export(SceneBatch(torch.zeros(0, 3, DIMSUM.features), DIMSUM), tmp_path / "none", TEXT).scenes == ()
    empty = torch.zeros(1, 3, DIMSUM.features)
    empty[..., -1] = 1.0
    export(SceneBatch(empty, DIMSUM), tmp_path / "empty")
    assert np.load(tmp_path / "empty" / "scene_000" / "scene.npz")["translations"].shape == (0, 3)


# -- a format of one's own ---------------------------------------------------------------------------


def test_a_format_of_ones_own_gets_poses_and_meshes(tmp_path):
    @register_format("height_list", summary="heights")
    def heights(scene, files: AssetFiles, folder):
        path = folder / "heights.txt"
        lines = [f"{o.name} {o.translation[2]:.3f} {len(files.parts(o.asset))}" for o in scene.objects]
        path.write_text("\n".join(lines))
        return path

    assert "height_list" in list_formats()
    assert formats._FORMATS["height_list"].summary == "heights"
    report = export(laid_scene(), tmp_path, ["height_list"])
    assert "steamer_lid_0 0.182 14" in report.scenes[0]["height_list"].read_text()
    with pytest.raises(InvalidInputError, match="letters, digits"):
        register_format("my format")


def test_an_installed_package_can_offer_a_format(tmp_path, monkeypatch):
    point = importlib.metadata.EntryPoint(
        "their_arrays", "scene_envs.export.arrays:write_npz", formats.ENTRY_POINT_GROUP
    )
    monkeypatch.setattr("scene_envs.registry.plugin_entry_points", {formats.ENTRY_POINT_GROUP: {point.name: point}}.get)
    assert "their_arrays" in list_formats()
    assert export(laid_scene(), tmp_path, "their_arrays").scenes[0]["their_arrays"].name == "scene.npz"


def test_odd_asset_names_become_identifiers_of_their_own():
    names = identifiers(["tea cup", "tea-cup", "tea_cup", "3d.part", ""])
    assert len(set(names.values())) == 5
    assert all(name.isidentifier() for name in names.values())


# -- other people's meshes ---------------------------------------------------------------------------


def odd_asset(visual):
    part = DIMSUM.library["serving_dish"].fine[0]
    return replace(DIMSUM.library["serving_dish"], visual=visual, fine=(part,), coarse=(part,), color=(10, 200, 30))


def test_an_asset_without_a_mesh_shows_its_parts_in_the_class_colour():
    mesh = visual_mesh(odd_asset(None))
    np.testing.assert_allclose(mesh.bounds, odd_asset(None).bounds)
    assert {tuple(rgb) for rgb in face_colors(mesh).tolist()} == {(10, 200, 30)}


def test_textures_become_colours_and_photographs_few_enough_of_them():
    box = trimesh.creation.box()
    image = Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], dtype=np.uint8))
    uv = np.column_stack([np.full(len(box.vertices), 0.9), np.full(len(box.vertices), 0.5)])
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=image)
    assert {tuple(rgb) for rgb in face_colors(box).tolist()} == {(0, 0, 255)}
    ball = trimesh.creation.icosphere(subdivisions=5)
    colors = np.random.default_rng(0).integers(0, 256, (len(ball.faces), 4)).astype(np.uint8)
    ball.visual = trimesh.visual.ColorVisuals(ball, face_colors=colors)
    textured = textured_mesh(odd_asset(ball))
    image, uv = np.asarray(textured.visual.material.baseColorTexture), textured.visual.uv[textured.faces[:, 0]]
    assert len(np.unique(textured.visual.uv, axis=0)) <= 1024
    shown = image[((1.0 - uv[:, 1]) * len(image)).astype(int), (uv[:, 0] * image.shape[1]).astype(int)]
    assert np.abs(shown.astype(int) - colors[:, :3]).max() <= 16
    np.testing.assert_allclose(textured.triangles, ball.triangles)


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
