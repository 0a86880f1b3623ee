"""Randomized physics and looks: what independent readers find in the files is what the JSON says."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import trimesh

from agents.cli import main
from scene_envs.errors import InvalidInputError
from scene_envs.export import export, place, verify
from scene_envs.export.randomization import randomize, read_randomization
from scene_envs.scene import SceneBatch
from tests.helpers.examples import load_example
from tests.helpers.export_scenes import DIMSUM, jittered_scene, laid_scene

SETTINGS = {"seed": 3, "mass": {"uniform": [0.5, 2.0]}, "friction": {"triangular": [0.2, 0.5, 0.9]}}
COLOR = {"color": {"normal": [0.9, 0.2]}}
LOOKS = {
    "seed": 3,
    "color": {"uniform": [0.3, 0.9]},
    "texture": {"choice": ["none", "checker", "gradient", "flat"]},
    "light_direction": {"normal": [0.0, 0.3]},
    "light_intensity": {"uniform": [0.5, 2.5]},
    "light_color": {"uniform": [0.6, 1.0]},
    "camera_position": {"uniform": [-0.2, 0.2]},
    "camera_target": {"uniform": [-0.05, 0.05]},
    "camera_fov_y": {"uniform": [-5.0, 10.0]},
}


def content(folder) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def said(folder, scene: str = "scene_000") -> dict:
    return json.loads((folder / scene / "randomization.json").read_text())


def objects(folder) -> dict:
    return said(folder)["objects"]


def seen(camera: dict) -> np.ndarray:
    """(3, 3): where x, y and z of the frame of OpenGL (right, up, backward) point, from position, target and up."""
    backward = np.subtract(camera["position"], camera["target"])
    right = np.cross(camera["up"], backward)
    up = np.cross(backward, right)
    return np.stack([axis / np.linalg.norm(axis) for axis in (right, up, backward)], axis=1)


def linear(colors) -> np.ndarray:
    """sRGB to linear light, by IEC 61966-2-1."""
    return np.where(np.array(colors) <= 0.04045, np.array(colors) / 12.92, ((np.array(colors) + 0.055) / 1.055) ** 2.4)


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
        tint = [0.5] * 3 if min(color) == 1.0 else color  # a grey of 0.5 is none, and the material's holds
        np.testing.assert_allclose(model.geom_rgba[visual], [*tint, 1.0], atol=1e-6)
        np.testing.assert_allclose(model.mat_rgba[model.geom_matid[visual]], [*color, 1.0], atol=1e-6)
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


def test_looks_are_those_of_their_distributions_and_of_the_scene_alone():
    batch, nominal = SceneBatch.concatenate([jittered_scene(3), laid_scene()]), DIMSUM.camera
    scenes = [randomize(scene, {**LOOKS, "seed": seed}) for seed in range(40) for scene in place(batch)]
    again = randomize(place(laid_scene())[0], {**SETTINGS, **LOOKS, "seed": 39})
    assert (again.light, again.camera) == (scenes[-1].light, scenes[-1].camera)
    assert [(x.color, x.texture) for x in again.objects] == [(x.color, x.texture) for x in scenes[-1].objects]
    assert len({scene.camera for scene in scenes}) == len({scene.light for scene in scenes}) == 80
    colors = np.array([x.color for scene in scenes for x in scene.objects])
    assert colors.min() >= 0.3
    assert colors.max() <= 0.9
    assert abs(colors.mean() - 0.6) < 4 * 0.6 / np.sqrt(12 * colors.size)  # four deviations of a mean of uniform draws
    textures = [x.texture for scene in scenes for x in scene.objects]
    for name in ("none", "checker", "gradient", "flat"):
        assert abs(textures.count(name) / len(textures) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / len(textures))
    for scene in scenes:
        assert np.linalg.norm(scene.light.direction) == pytest.approx(1.0, abs=1e-15)
        assert 0.5 <= scene.light.intensity <= 2.5
        assert 0.6 <= min(scene.light.color) <= max(scene.light.color) <= 1.0
        assert np.abs(np.subtract(scene.camera.position, nominal.position)).max() <= 0.2
        assert np.abs(np.subtract(scene.camera.target, nominal.target)).max() <= 0.05
        assert -5.0 <= scene.camera.fov_y - nominal.fov_y <= 10.0
        assert (scene.camera.up, scene.camera.width) == (nominal.up, nominal.width)
    plain = randomize(place(laid_scene())[0], SETTINGS)
    assert (plain.light, plain.camera) == (place(laid_scene())[0].light, nominal)


def test_a_scene_that_repeats_looks_different_each_time(tmp_path):
    batch = SceneBatch.concatenate([laid_scene(), jittered_scene(3), laid_scene()])
    export(batch, tmp_path / "three", "npz", randomization=LOOKS)
    export(batch[[1, 2, 0]], tmp_path / "turned", "npz", randomization=LOOKS)
    names = ("scene_000", "scene_001", "scene_002")
    first, other, again = (said(tmp_path / "three", name) for name in names)
    assert [said(tmp_path / "turned", name) for name in names] == [other, first, again]
    assert first["camera"] != again["camera"]
    assert first["objects"]["teacup_0"]["color"] != again["objects"]["teacup_0"]["color"]


def test_mujoco_reads_the_looks_and_physics_stays_bit_for_bit(tmp_path):
    models = []
    for name, settings in (("plain", {}), ("looks", LOOKS)):
        export(laid_scene(), tmp_path / name, "mjcf", randomization=settings)
        models.append(mujoco.MjModel.from_xml_path(str(tmp_path / name / "scene_000" / "scene.xml")))
    plain, model = models
    for field in ("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "body_iquat", "geom_friction"):
        np.testing.assert_array_equal(getattr(model, field), getattr(plain, field), err_msg=field)
    states = [mujoco.MjData(one) for one in models]
    for one, data in zip(models, states, strict=True):
        mujoco.mj_step(one, data, 20)
    for field in ("pos", "dist", "frame"):
        np.testing.assert_array_equal(getattr(states[0].contact, field), getattr(states[1].contact, field))
    np.testing.assert_array_equal(states[0].qpos, states[1].qpos)
    drawn = said(tmp_path / "looks")
    light, camera = drawn["light"], drawn["camera"]
    np.testing.assert_allclose(model.light("lamp").dir, light["direction"], atol=1e-12)
    np.testing.assert_allclose(
        model.light("lamp").diffuse, 0.3 * light["intensity"] * np.array(light["color"]), rtol=1e-6
    )
    np.testing.assert_allclose(states[1].cam("scene").xpos, camera["position"], atol=1e-12)
    np.testing.assert_allclose(states[1].cam("scene").xmat.reshape(3, 3), seen(camera), atol=1e-12)
    assert model.cam("scene").fovy[0] == pytest.approx(camera["fov_y"], rel=1e-12)
    kinds = set()
    for name, row in drawn["objects"].items():
        visual = model.body(name).geomadr[0]
        np.testing.assert_allclose(model.geom_rgba[visual], [*row["color"], 1.0], atol=1e-6)
        texture = model.tex(model.mat_texid[model.geom_matid[visual], 1])
        pixels = model.tex_data[texture.adr[0] :][: 3 * texture.width[0] * texture.height[0]].reshape(-1, 3)
        assert row["texture"] == "none" or (pixels == pixels[:, :1]).all()  # grey
        levels = {"checker": {102, 255}, "flat": {255}}.get(row["texture"], set(pixels[:, 0].tolist()))
        assert set(pixels[:, 0].tolist()) == levels
        kinds.add(row["texture"])
    assert kinds == {"none", "checker", "gradient", "flat"}
    assert drawn["units"]["camera_fov_y"] == "added to the vertical field of view, degrees"
    assert drawn["left_out"] == {}


def test_usd_reads_the_looks(tmp_path):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdLux, UsdShade

    export(laid_scene(), tmp_path / "plain", "usd")
    plain = Usd.Stage.Open(str(tmp_path / "plain" / "scene_000.usda"))
    assert not [prim for prim in plain.Traverse() if prim.IsA(UsdGeom.Camera) or prim.HasAPI(UsdLux.LightAPI)]
    report = export(laid_scene(), tmp_path / "looks", "usd", randomization=LOOKS)
    stage = Usd.Stage.Open(str(report.scenes[0]["usd"]))
    drawn = said(tmp_path / "looks")
    lamp = UsdLux.DistantLight(stage.GetPrimAtPath("/World/lamp"))
    assert lamp.GetIntensityAttr().Get() == pytest.approx(1000.0 * drawn["light"]["intensity"], rel=1e-6)
    np.testing.assert_allclose(lamp.GetColorAttr().Get(), linear(drawn["light"]["color"]), rtol=1e-5)
    turn = np.array(UsdGeom.Xformable(lamp).ComputeLocalToWorldTransform(0))[:3, :3].T
    np.testing.assert_allclose(turn @ [0.0, 0.0, -1.0], drawn["light"]["direction"], atol=1e-12)  # where it shines
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera()
    assert camera.GetFieldOfView(camera.FOVVertical) == pytest.approx(drawn["camera"]["fov_y"], rel=1e-5)
    assert camera.aspectRatio == pytest.approx(drawn["camera"]["width"] / drawn["camera"]["height"], rel=1e-6)
    pose = np.array(camera.transform).T
    np.testing.assert_allclose(pose[:3, 3], drawn["camera"]["position"], atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3], seen(drawn["camera"]), atol=1e-12)
    for name, row in drawn["objects"].items():
        prim = stage.GetPrimAtPath(f"/World/{name}/visual")
        shown, own = (
            UsdGeom.PrimvarsAPI(other.GetPrimAtPath(f"/World/{name}/visual")).GetPrimvar("displayColor")
            for other in (stage, plain)
        )
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        (source,), _ = surface.GetInput("diffuseColor").GetConnectedSources()
        shader = UsdShade.Shader(source.source.GetPrim())
        if row["texture"] == "none":
            assert shader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
            colors = np.array(own.ComputeFlattened())  # linear light; the factor is on sRGB
            screen = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * colors ** (1 / 2.4) - 0.055)
            np.testing.assert_allclose(shown.ComputeFlattened(), linear(screen * row["color"]), atol=1e-6)
        else:
            assert shader.GetIdAttr().Get() == "UsdUVTexture"
            scale = shader.GetInput("scale").Get()
            np.testing.assert_allclose(scale, [*linear(row["color"]), 1.0], rtol=1e-5)
            image = Path(shader.GetInput("file").Get().resolvedPath)
            assert image.name == f"visual_{row['texture']}.png"
            (reader,), _ = shader.GetInput("st").GetConnectedSources()
            assert UsdShade.Shader(reader.source.GetPrim()).GetInput("varname").Get() == "st"
        corners = np.array(UsdGeom.PrimvarsAPI(prim).GetPrimvar("st").Get())
        assert len(corners) == len(UsdGeom.Mesh(prim).GetPointsAttr().Get())
        assert (corners.min(), corners.max()) == (0.0, 1.0)


def test_other_formats_hold_colours_and_textures_and_say_what_they_leave_out(tmp_path):
    formats = ["urdf", "sdf", "glb", "npz"]
    export(laid_scene(), tmp_path, formats, randomization=LOOKS)
    folder, drawn = tmp_path / "scene_000", said(tmp_path)
    lamp = ["light_direction", "light_intensity", "light_color"]
    camera = ["camera_position", "camera_target", "camera_fov_y"]
    rest = {"glb": lamp + camera, "npz": ["color", "texture", *lamp, *camera], "sdf": camera, "urdf": lamp + camera}
    assert drawn["left_out"] == rest
    world = ElementTree.parse(folder / "world.sdf").getroot().find("world")
    direction = [float(x) for x in world.find("light/direction").text.split()]
    np.testing.assert_array_equal(direction, drawn["light"]["direction"])
    assert float(world.find("light/intensity").text) == drawn["light"]["intensity"]
    urdfs = {item["name"]: item["urdf"] for item in json.loads((folder / "objects.json").read_text())["objects"]}
    scene = trimesh.load(folder / "scene.glb")
    for name, row in drawn["objects"].items():
        stem = "visual" if row["texture"] == "none" else f"visual_{row['texture']}"
        visual = world.find(f"model[@name='{name}']/link/visual")
        assert visual.find("material/diffuse").text.split()[:3] == [repr(x) for x in row["color"]]
        for place_of in ("geometry/mesh/uri", "material/pbr/metal/albedo_map"):
            assert (folder / visual.find(place_of).text).is_file()
        assert Path(visual.find("geometry/mesh/uri").text).stem == stem
        visual = ElementTree.parse(folder / urdfs[name]).getroot().find("link/visual")
        assert visual.find("material/color").attrib["rgba"].split()[:3] == [repr(x) for x in row["color"]]
        mesh = trimesh.load((folder / urdfs[name]).parent / visual.find("geometry/mesh").attrib["filename"])
        image = np.asarray(mesh.visual.material.image)[..., :3]
        (node,) = (geometry for _, geometry in (scene.graph[name],))
        material = scene.geometry[node].visual.material
        np.testing.assert_allclose(material.baseColorFactor[:3] / 255.0, linear(row["color"]), atol=0.51 / 255.0)
        np.testing.assert_array_equal(np.asarray(material.baseColorTexture)[..., :3], image)


def test_worlds_hold_the_looks_of_each_scene(tmp_path):
    export(SceneBatch.concatenate([laid_scene(), jittered_scene(3)]), tmp_path, ["mjcf", "worlds"], randomization=LOOKS)
    example = load_example("worlds")
    for world, folder in enumerate(("scene_000", "scene_001")):
        own = mujoco.MjModel.from_xml_path(str(tmp_path / folder / "scene.xml"))
        model, _ = example.mujoco_world(tmp_path / "worlds.npz", world)
        for field in ("light_dir", "light_diffuse", "cam_pos", "cam_quat", "cam_fovy"):
            np.testing.assert_allclose(getattr(model, field), getattr(own, field), atol=1e-12, err_msg=field)
        for body, name in enumerate(np.load(tmp_path / "worlds.npz")["names"][world].tolist(), start=1):
            materials = [
                (m.mat_rgba[material].tolist(), m.tex(m.mat_texid[material, 1]).name)
                for m, b in ((model, model.body(body)), (own, own.body(name)))
                for material in [m.geom_matid[b.geomadr[0]]]
            ]
            assert materials[0] == materials[1], name


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


def test_the_certificate_judges_the_randomized_files(tmp_path, monkeypatch):
    monkeypatch.setattr("scene_envs.export.verification._LATE", 0.2)  # whatever moves later
    export(laid_scene(), tmp_path, ["npz", "mjcf"], randomization=SETTINGS)
    assert json.loads((tmp_path / "scene_000" / "randomization.json").read_text())["verdict"] == "nominal"
    report = verify(tmp_path)
    assert "MuJoCo, MJCF" in report.versions
    assert "other friction or masses" in report.missing["mujoco engine"]
    export(laid_scene(), tmp_path / "looks", ["npz", "mjcf"], randomization=LOOKS)
    assert "mujoco engine" in verify(tmp_path / "looks").versions  # looks move nothing


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
    with pytest.raises(InvalidInputError, match="light_intensity=-1 was drawn"):
        export(laid_scene(), tmp_path / "a", "mjcf", randomization={"light_intensity": {"uniform": [-1.0, -1.0]}})
    with pytest.raises(InvalidInputError, match="between 0 and 180 degrees, got fov_y=245"):
        export(laid_scene(), tmp_path / "a", "mjcf", randomization={"camera_fov_y": {"uniform": [200.0, 200.0]}})
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
        ({"mass": {"choice": [1, 2]}}, "mass: unknown distribution 'choice'"),
        ({"texture": {"uniform": [0, 1]}}, "texture: unknown distribution 'uniform'"),
        ({"texture": {"choice": ["checker", "marble"]}}, r"texture: unknown marble.*\[none, checker, gradient, flat\]"),
        ({"mass": {"normal": [0, float("inf")]}}, "draws numbers that are not finite"),
        ({"mass": {"uniform": [0, float("inf")]}}, "range exceeds valid bounds"),
        ({"mass": {"uniform": np.array([1.0, 2.0])}}, "not JSON serializable"),
        ({"seed": -1}, "non-negative"),
        ({"mass": {"uniform": [2, 1]}}, "mass: high - low < 0"),
        ({"seed": [1, 2]}, r"seed=\[1, 2\] must be"),
        ({"mass": {"uniform": [0.8]}}, r"mass: uniform takes 2 numbers, got \[0.8\]"),
        ({"mass": {"uniform": [1, 2, 3]}}, "mass: uniform takes 2 numbers"),
        ({"friction": {"triangular": [0.2, 0.5]}}, "friction: triangular takes 3 numbers"),
        ({"mass": {"uniform": [[1, 2, 3], [2, 3, 4]]}}, "mass: uniform takes 2 numbers"),
        ({"mass": {"uniform": [True, 2]}}, "mass: uniform takes 2 numbers"),
        ({"mass": {"uniform": {"low": 1, "high": 2}}}, "mass: {.*} is not one distribution with the list"),
        ({"mass": {"uniform": [1, 2], "normal": [1, 2]}}, "mass: {.*} is not one distribution"),
        ({"texture": {"choice": "checker"}}, "texture: {'choice': 'checker'} is not one distribution"),
        ({"texture": {"choice": [["flat"], None]}}, "texture: unknown None, \\['flat'"),
    ],
)
def test_what_cannot_be_drawn_is_named(settings, message):
    with pytest.raises(InvalidInputError, match=message):
        read_randomization(settings)


def test_a_file_is_read_as_it_is_meant(tmp_path):
    path = tmp_path / "values.yaml"
    path.write_text("mass: {uniform: [1e-3, 2.5E+0]}\nlight_direction: {normal: [-1e-1, .5e0]}\n")
    found = read_randomization(path)
    assert (found["mass"], found["light_direction"]) == ({"uniform": [0.001, 2.5]}, {"normal": [-0.1, 0.5]})
    for text, message in (("", "it is empty"), ("# no keys\n", "it is empty"), ("- mass\n", r"it holds \['mass'\]")):
        path.write_text(text)
        with pytest.raises(InvalidInputError, match=message):
            read_randomization(path)
    with np.errstate(over="ignore"), pytest.raises(InvalidInputError, match="has a length of inf"):
        export(laid_scene(), tmp_path / "a", "mjcf", randomization={"light_direction": {"uniform": [1e154, 1e154]}})


def test_formats_join_a_randomized_export_and_other_values_are_named(tmp_path):
    batch = laid_scene()
    export(batch, tmp_path, "mjcf", randomization={"mass": {"uniform": (0.7, 1.4)}})
    assert export(batch, tmp_path, "sdf", randomization={"mass": {"uniform": [0.7, 1.4]}}).formats == ("sdf",)
    with pytest.raises(InvalidInputError, match="of these scenes with randomization="):
        export(batch, tmp_path, "sdf")
    with pytest.raises(InvalidInputError, match=r"of these scenes with friction=0.6, not 0.5"):
        export(batch, tmp_path, "sdf", friction=0.5, randomization={"mass": {"uniform": [0.7, 1.4]}})


def test_the_commands_refuse_what_cannot_be_drawn_and_lost_settings_before_they_work(tmp_path, capsys):
    file = tmp_path / "colour.yaml"
    file.write_text("colour: {uniform: [0.5, 1]}")
    assert main(["export", "scenes=none", "formats=drake", f"randomization={file}"]) == 2
    assert "unknown key 'colour'; write seed: 0" in capsys.readouterr().err
    file.write_text("color: {uniform: [0.5, 1]}")
    assert main(["sample", f"randomization={file}"]) == 2
    assert "randomization= changes exported scenes; add export=" in capsys.readouterr().err
