"""Randomized masses, frictions and colours: what independent readers find in the files is what the JSON says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from agents.cli import main
from scene_envs.errors import InvalidInputError
from scene_envs.export import export, place, verify
from scene_envs.export.randomization import randomize, read_randomization
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import jittered_scene, laid_scene

SETTINGS = {"seed": 3, "mass": {"uniform": [0.5, 2.0]}, "friction": {"triangular": [0.2, 0.5, 0.9]}}
COLOR = {"color": {"normal": [0.9, 0.2]}}


def content(folder) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def objects(folder) -> dict:
    return json.loads((folder / "scene_000" / "randomization.json").read_text())["objects"]


def assets() -> dict:
    return {thing.name: thing for thing in place(laid_scene())[0].objects if not thing.welded}


def test_draws_are_those_of_the_seed_and_the_scene_alone():
    batch = SceneBatch.concatenate([jittered_scene(3), laid_scene()])
    one = randomize(place(laid_scene())[0], SETTINGS)
    other = randomize(place(batch)[1], {**COLOR, **SETTINGS})
    assert [(x.mass, x.friction) for x in one.objects] == [(x.mass, x.friction) for x in other.objects]
    assert [x.mass for x in one.objects] != [x.mass for x in randomize(place(batch)[0], SETTINGS).objects]
    again = randomize(place(laid_scene())[0], {**SETTINGS, "seed": 4})
    assert all(x.friction != y.friction for x, y in zip(one.objects, again.objects, strict=True))
    for thing in one.objects:
        assert 0.2 <= thing.friction <= 0.9
        np.testing.assert_allclose(thing.inertia * thing.asset.mass, thing.asset.inertia * thing.mass)
        assert 0.5 * thing.asset.mass <= thing.mass <= 2.0 * thing.asset.mass


def test_mujoco_reads_what_the_json_says(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    export(laid_scene(), tmp_path, "mjcf", randomization={**SETTINGS, **COLOR})
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene_000" / "scene.xml"))
    drawn = objects(tmp_path)
    assert len({row["mass"] for row in drawn.values()}) > 8
    for name, thing in assets().items():
        body = model.body(name)
        assert body.mass[0] == pytest.approx(drawn[name]["mass"], rel=1e-12)
        moments = np.linalg.eigvalsh(thing.inertia) * drawn[name]["mass"] / thing.mass
        np.testing.assert_allclose(body.inertia, moments, rtol=1e-9)
        visual, *parts = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        assert set(model.geom_friction[parts, 0]) == {drawn[name]["friction"]}
        color = drawn[name]["color"]
        tint = [0.5] * 3 if min(color) == 1.0 else color  # a grey of 0.5 is none
        np.testing.assert_allclose(model.geom_rgba[visual], [*tint, 1.0], atol=1e-6)
    assert min(min(row["color"]) for row in drawn.values()) < 0.9


def test_pybullet_and_a_urdf_reader_read_what_the_json_says(tmp_path):
    pybullet = pytest.importorskip("pybullet")
    yourdfpy = pytest.importorskip("yourdfpy")
    export(laid_scene(), tmp_path, "urdf", randomization=SETTINGS)
    drawn, own = objects(tmp_path), assets()
    client = pybullet.connect(pybullet.DIRECT)
    try:
        for item in json.loads((tmp_path / "scene_000" / "objects.json").read_text())["objects"]:
            if item["welded"]:
                continue
            path = tmp_path / "scene_000" / item["bullet_urdf"]
            flags = pybullet.URDF_USE_INERTIA_FROM_FILE
            found = pybullet.getDynamicsInfo(
                pybullet.loadURDF(str(path), flags=flags, physicsClientId=client), -1, client
            )
            assert found[0] == pytest.approx(drawn[item["name"]]["mass"])
            assert found[1] ** 2 == pytest.approx(drawn[item["name"]]["friction"])
            robot = yourdfpy.URDF.load(str(tmp_path / "scene_000" / item["urdf"]), load_meshes=False)
            (link,) = robot.link_map.values()
            assert link.inertial.mass == pytest.approx(drawn[item["name"]]["mass"], rel=1e-12)
            factor = drawn[item["name"]]["mass"] / own[item["name"]].mass
            np.testing.assert_allclose(link.inertial.inertia, own[item["name"]].inertia * factor, rtol=1e-9, atol=1e-15)
    finally:
        pybullet.disconnect(client)


def test_usd_reads_what_the_json_says(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdPhysics, UsdShade

    report = export(laid_scene(), tmp_path, "usd", randomization=SETTINGS)
    stage = Usd.Stage.Open(str(report.scenes[0]["usd"]))
    drawn = objects(tmp_path)
    for name, thing in assets().items():
        mass = UsdPhysics.MassAPI(stage.GetPrimAtPath(f"/World/{name}"))
        assert mass.GetMassAttr().Get() == pytest.approx(drawn[name]["mass"], rel=1e-6)
        moments = np.linalg.eigvalsh(thing.inertia) * drawn[name]["mass"] / thing.mass
        np.testing.assert_allclose(np.sort(mass.GetDiagonalInertiaAttr().Get()), moments, rtol=1e-5)
        part = stage.GetPrimAtPath(f"/World/{name}/collision/part_00")
        material, _ = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial("physics")
        friction = UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get()
        assert friction == pytest.approx(drawn[name]["friction"], rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "file"), [("sdf", "world.sdf"), ("drake", "scene.dmd.yaml")])
def test_drake_reads_what_the_json_says(name, file, tmp_path):
    drake = pytest.importorskip("pydrake.all")
    export(laid_scene(), tmp_path, name, randomization=SETTINGS)
    plant, graph = drake.AddMultibodyPlantSceneGraph(drake.DiagramBuilder(), time_step=0.002)
    parser = drake.Parser(plant)
    if name == "drake":
        parser.package_map().AddPackageXml(tmp_path / "package.xml")
    parser.AddModels(tmp_path / "scene_000" / file)
    drawn = objects(tmp_path)
    for thing in assets():
        body = plant.get_body(plant.GetBodyIndices(plant.GetModelInstanceByName(thing))[0])
        assert body.default_mass() == pytest.approx(drawn[thing]["mass"], rel=1e-12)
        for part in plant.GetCollisionGeometriesForBody(body):
            properties = graph.model_inspector().GetProximityProperties(part)
            friction = properties.GetProperty("material", "coulomb_friction").dynamic_friction()
            assert friction == pytest.approx(drawn[thing]["friction"], rel=1e-12)


def test_without_distributions_nothing_changes(tmp_path):
    formats = ["mjcf", "urdf", "sdf", "drake"]
    export(laid_scene(), tmp_path / "plain", formats)
    export(laid_scene(), tmp_path / "empty", formats, randomization={})
    assert content(tmp_path / "plain") == content(tmp_path / "empty")
    fixed = {"mass": {"uniform": [1.0, 1.0]}, "friction": {"uniform": [0.6, 0.6]}}
    export(laid_scene(), tmp_path / "fixed", formats, randomization=fixed)
    found = content(tmp_path / "fixed")
    assert found.pop("scene_000/randomization.json")
    assert {**found, "export.json": b""} == {**content(tmp_path / "plain"), "export.json": b""}
    with pytest.raises(InvalidInputError, match="export of these scenes with randomization=None, not"):
        export(laid_scene(), tmp_path / "plain", formats, randomization=SETTINGS)


def test_the_certificate_judges_the_randomized_files(tmp_path):
    export(laid_scene(), tmp_path, ["npz", "mjcf"], randomization=SETTINGS)
    assert json.loads((tmp_path / "scene_000" / "randomization.json").read_text())["verdict"] == "nominal"
    report = verify(tmp_path)
    assert "MuJoCo, MJCF" in report.versions
    assert "other friction or masses" in report.missing["mujoco engine"]


def test_wrong_input_is_named(tmp_path):
    for wrong in (
        {"weight": {"uniform": [1, 2]}},
        {"mass": {"beta": [1, 2]}},
        {"mass": 2.0},
        {"mass": {"uniform": ["a", "b"]}},
    ):
        with pytest.raises(InvalidInputError, match="write seed: 0 and some of mass, friction, color"):
            read_randomization(wrong)
    with pytest.raises(InvalidInputError, match="must be above 0"):
        export(laid_scene(), tmp_path / "a", "mjcf", randomization={"mass": {"uniform": [-2.0, -1.0]}})
    with pytest.raises(InvalidInputError, match=r"only mjcf carries randomized colours.*urdf"):
        export(laid_scene(), tmp_path / "a", ["mjcf", "urdf"], randomization=COLOR)
    assert not (tmp_path / "a").exists()


def test_the_command_takes_a_file(tmp_path, capsys):
    scenes = laid_scene().save(tmp_path / "scenes.safetensors")
    path = tmp_path / "values.yaml"
    path.write_text("seed: 3\nmass: {uniform: [0.5, 2.0]}\nfriction: {triangular: [0.2, 0.5, 0.9]}\n")
    words = ["export", f"scenes={scenes}", "formats=mjcf", "workers=0", f"randomization={path}"]
    assert main([*words, f"output={tmp_path / 'out'}"]) == 0
    export(laid_scene(), tmp_path / "same", "mjcf", randomization=SETTINGS)
    assert objects(tmp_path / "out") == objects(tmp_path / "same")
    path.write_text("mass: heavy\n")
    assert main([*words, f"output={tmp_path / 'other'}"]) == 2
    assert "randomization=" in capsys.readouterr().err


def test_worlds_hold_what_the_json_says(tmp_path):
    export(laid_scene(), tmp_path, "worlds", randomization=SETTINGS)
    found, drawn = np.load(tmp_path / "worlds.npz"), objects(tmp_path)
    for body, name in enumerate(found["names"][0].tolist(), start=1):
        if name in assets():
            assert found["world/body_mass"][0, body] == pytest.approx(drawn[name]["mass"])
    assert {row["friction"] for row in drawn.values()} == set(found["world/geom_friction"][0, :, 0].tolist())


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weight": {"uniform": [1, 2]}}, "unknown key 'weight'"),
        ({"mass": {"gauss": [1, 2]}}, "mass: unknown distribution 'gauss'"),
        ({"mass": {"uniform": [0, float("inf")]}}, "range exceeds valid bounds"),
        ({"mass": {"uniform": np.array([1.0, 2.0])}}, "not JSON serializable"),
        ({"seed": -1}, "non-negative"),
    ],
)
def test_what_cannot_be_drawn_is_named(settings, message):
    with pytest.raises(InvalidInputError, match=message):
        read_randomization(settings)


def test_formats_join_a_randomized_export_and_other_values_are_named(tmp_path):
    batch = laid_scene()
    export(batch, tmp_path, "mjcf", randomization={"mass": {"uniform": (0.7, 1.4)}})
    assert export(batch, tmp_path, "sdf", randomization={"mass": {"uniform": [0.7, 1.4]}}).formats == ("sdf",)
    with pytest.raises(InvalidInputError, match="of these scenes with randomization="):
        export(batch, tmp_path, "sdf")
    with pytest.raises(InvalidInputError, match=r"of these scenes with friction=0.6, not 0.5"):
        export(batch, tmp_path, "sdf", friction=0.5, randomization={"mass": {"uniform": [0.7, 1.4]}})


def test_the_commands_refuse_colours_and_lost_settings_before_they_work(tmp_path, capsys):
    file = tmp_path / "colour.yaml"
    file.write_text("color: {uniform: [0.5, 1]}")
    assert main(["export", "scenes=none", "formats=drake", f"randomization={file}"]) == 2
    assert "only mjcf carries randomized colours" in capsys.readouterr().err
    assert main(["sample", "export=[mjcf, sdf]", f"randomization={file}"]) == 2
    assert "leave out color, or sdf" in capsys.readouterr().err
    assert main(["sample", f"randomization={file}"]) == 2
    assert "randomization= changes exported scenes; add export=" in capsys.readouterr().err
