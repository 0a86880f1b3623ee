"""Movable joints of a user's model in exports, against the simulators' own reading of the user's file."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from scene_envs.assets import import_report, load_library
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.export import ExportReport, export, verify
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, FixedObject, SceneType, register_scene_type

BACK = {"urdf": '<box size="0.4 0.02 0.6"/>', "sdf": "<box><size>0.4 0.02 0.6</size></box>"}
DOOR = {"urdf": '<box size="0.38 0.02 0.58"/>', "sdf": "<box><size>0.38 0.02 0.58</size></box>"}
TRAY = {"urdf": '<box size="0.3 0.2 0.1"/>', "sdf": "<box><size>0.3 0.2 0.1</size></box>"}
LID = {"urdf": '<box size="0.2 0.1 0.02"/>', "sdf": "<box><size>0.2 0.1 0.02</size></box>"}


def shapes(shape: str, place: str, name: str = "") -> str:
    return "".join(f"<{tag}{name}>{place}<geometry>{shape}</geometry></{tag}>" for tag in ("visual", "collision"))


def urdf(hinge: str = '<limit lower="-1.9" upper="0.1" effort="9" velocity="2"/>', rest: str = "") -> str:
    links = {
        "back": shapes(BACK["urdf"], '<origin xyz="0 0.2 0.3"/>'),
        "door": shapes(DOOR["urdf"], '<origin xyz="0.2 0.02 0.3"/>')
        + '<inertial><origin xyz="0.2 0.02 0.3"/><mass value="2"/>'
        '<inertia ixx="0.06" iyy="0.087" izz="0.027" ixy="0" ixz="0" iyz="0"/></inertial>',
        "knob": shapes('<sphere radius="0.02"/>', ""),
        "tray": shapes(TRAY["urdf"], ""),
        "lid": shapes(LID["urdf"], '<origin xyz="0.05 0 0.02"/>'),
    }
    return (
        "<robot name='cabinet'>"
        + "".join(f'<link name="{name}">{content}</link>' for name, content in links.items())
        + f"""<joint name="hinge" type="revolute"><parent link="back"/><child link="door"/>
<origin xyz="-0.2 -0.21 0.01" rpy="0 0 0.1"/><axis xyz="0 0 1"/>{hinge}<dynamics damping="0.3" friction="0.1"/></joint>
<joint name="k" type="fixed"><parent link="door"/><child link="knob"/><origin xyz="0.35 -0.03 0.3"/></joint>
<joint name="slide" type="prismatic"><parent link="back"/><child link="tray"/><origin xyz="0 0.05 0.3" rpy="0 0 0.3"/>
<axis xyz="0.6 -0.8 0"/><limit lower="0" upper="0.2" effort="9" velocity="2"/></joint>
<joint name="lid" type="continuous"><parent link="tray"/><child link="lid"/><origin xyz="0 0.02 0.08" rpy="0 0.2 0"/>
<axis xyz="0.6 0 0.8"/><dynamics friction="1"/></joint>{rest}</robot>"""
    )


def sdf(version: str = "1.9", axis: str = '<xyz expressed_in="__model__">0 0 1</xyz>', more: str = "") -> str:
    """The joint of the door is beside the origin of the link, and its axis is that of the model."""
    links = {
        "back": shapes(BACK["sdf"], "<pose>0 0.2 0.3 0 0 0</pose>", ' name="v"'),
        "door": "<pose>-0.1 -0.2 0.3 0.3 0 0.1</pose>" + shapes(DOOR["sdf"], "<pose>0.1 0 0 0 0 0</pose>", ' name="v"'),
        "tray": "<pose>0 0.05 0.3 0 0 0.3</pose>" + shapes(TRAY["sdf"], "", ' name="v"'),
    }
    return (
        f'<sdf version="{version}"><model name="cabinet">'
        + "".join(f'<link name="{name}">{content}</link>' for name, content in links.items())
        + f"""<joint name="hinge" type="revolute"><pose>-0.1 0.01 0 0.2 0.1 0</pose><parent>back</parent>
<child>door</child><axis>{axis}<limit><lower>-1.9</lower><upper>0.1</upper></limit>
<dynamics><damping>0.3</damping><friction>0.1</friction></dynamics></axis></joint><joint name="slide" type="prismatic">
<parent>back</parent><child>tray</child><axis><xyz>0.6 -0.8 0</xyz><limit><lower>0</lower><upper>0.2</upper></limit>
</axis></joint><joint name="w" type="fixed"><parent>world</parent><child>back</child></joint>{more}</model></sdf>"""
    )


MJCF = """<mujoco><compiler angle="radian"/><worldbody><body name="back" pos="1 2 3" euler="0 0 0.4">
<geom type="box" size="0.2 0.01 0.3" pos="0 0.2 0.3"/><body name="door" pos="-0.2 -0.2 0" euler="0 0 0.1">
<joint name="hinge" axis="0 0 2" pos="0.01 0.02 0" range="-1.7 0.3" ref="0.2" damping="0.3" frictionloss="0.1"/>
<geom type="box" size="0.19 0.01 0.29" pos="0.2 0 0.3"/></body><body name="tray" pos="0 0.05 0.3" euler="0 0 0.3">
<joint name="slide" type="slide" axis="0.6 -0.8 0" range="0 0.2"/><geom type="box" size="0.15 0.1 0.05"/>
<body name="lid" pos="0 0 0.08"><joint name="lid" axis="0.6 0 0.8"/><geom type="box" size="0.1 0.05 0.01"/></body>
</body><body name="ball" pos="0 0 0.5"><joint name="ball" type="ball"/><geom size="0.02"/></body>
</body></worldbody></mujoco>"""
SOURCES = {"cabinet.urdf": urdf(), "cabinet.sdf": sdf(), "old.sdf": sdf("1.4", "<xyz>0 0 1</xyz>"), "cabinet.xml": MJCF}
ZERO = {"cabinet.xml": {"hinge": 0.2}}  # of a joint in the user's file where it is frozen


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))


def scenes(folder: Path, file: str, text: str, keys: str = "welded: true", welded: tuple[str, ...] = ()) -> SceneBatch:
    """One scene of one asset, turned and away from the origin."""
    folder.mkdir(exist_ok=True)
    (folder / file).write_text(text)
    (folder / "library.yaml").write_text(f"- {{file: {file}, name: cabinet, {keys}}}")
    name = "joints_" + "".join(c if c.isalnum() else "_" for c in str(folder))
    register_scene_type(
        SceneType(
            name=name,
            assets=("cafe_table", "cabinet"),
            slots=2,
            workspace=((-2.0, -2.0, -0.02), (2.0, 2.0, 2.0)),
            welded=("cafe_table", *welded),
            fixed=(FixedObject("cafe_table"),),
            camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
            asset_folders=(str(folder),),
        )
    )
    turns = np.stack([np.eye(3), Rotation.from_euler("z", 0.7).as_matrix()])
    places = torch.tensor([[[0.0, 0.0, 0.0], [1.2, 0.3, 0.0]]])
    return SceneBatch.from_parts(places, torch.tensor(turns[None]).float(), torch.tensor([[0, 1]]), name)


Poses = Callable[[dict[str, float]], dict[str, np.ndarray]]
"""The poses (4, 4) of the links for some positions of the joints."""


def in_drake(path: Path, model: str = "", weld: str = "", package: Path | None = None) -> Poses:
    drake = pytest.importorskip("pydrake.all")
    logging.getLogger("drake").setLevel(logging.ERROR)
    plant = drake.MultibodyPlant(0.0)
    parser = drake.Parser(plant)
    if package:
        parser.package_map().AddPackageXml(str(package))
    found = parser.AddModels(str(path))
    one = plant.GetModelInstanceByName(model) if model else found[0]
    if weld:
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(weld))
    plant.Finalize()
    assert plant.num_velocities() == sum(plant.get_joint(j).num_velocities() for j in plant.GetJointIndices(one))
    context = plant.CreateDefaultContext()

    def poses(positions: dict[str, float]) -> dict[str, np.ndarray]:
        for name, value in positions.items():
            joint = plant.GetJointByName(name if plant.HasJointNamed(name, one) else f"{name}_joint", one)
            (joint.set_angle if hasattr(joint, "set_angle") else joint.set_translation)(context, value)
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(one)]
        return {body.name(): plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4() for body in bodies}

    return poses


def in_mujoco(path: Path, prefix: str = "") -> Poses:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)

    def poses(positions: dict[str, float]) -> dict[str, np.ndarray]:
        for name, value in positions.items():
            data.joint(f"{prefix}{name}").qpos[0] = value
        mujoco.mj_kinematics(model, data)
        found = {}
        for index in range(1, model.nbody):
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = data.xmat[index].reshape(3, 3), data.xpos[index]
            found[model.body(index).name.removeprefix(prefix)] = matrix
        return found

    return poses


def in_pybullet(path: Path) -> Poses:
    pybullet = pytest.importorskip("pybullet")
    client = pytest.importorskip("pybullet_utils.bullet_client").BulletClient(pybullet.DIRECT)
    item = json.loads(path.read_text())["objects"][1]
    turn = np.roll(item["quaternion_wxyz"], -1).tolist()
    body = client.loadURDF(str(path.parent / item["urdf"]), item["translation"], turn, useFixedBase=item["welded"])
    rows = {client.getJointInfo(body, j)[1].decode(): j for j in range(client.getNumJoints(body))}

    def poses(positions: dict[str, float]) -> dict[str, np.ndarray]:
        for name, value in positions.items():
            client.resetJointState(body, rows[name], value)
        found = {}
        for row in rows.values():
            state = client.getLinkState(body, row, computeForwardKinematics=True)
            matrix = np.eye(4)
            matrix[:3, 3], matrix[:3, :3] = state[4], Rotation.from_quat(state[5]).as_matrix()
            found[client.getJointInfo(body, row)[12].decode()] = matrix
        return found

    return poses


def in_usd(path: Path) -> Poses:
    """By the frames of UsdPhysics' joints."""
    Usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdPhysics

    stage = Usd.Stage.Open(str(path))

    def frame(joint: Any, end: int) -> np.ndarray:
        matrix, prim = np.eye(4), joint.GetPrim()
        matrix[:3, 3] = prim.GetAttribute(f"physics:localPos{end}").Get()
        turn = prim.GetAttribute(f"physics:localRot{end}").Get()
        matrix[:3, :3] = Rotation.from_quat([*turn.GetImaginary(), turn.GetReal()]).as_matrix()
        return matrix

    def poses(positions: dict[str, float]) -> dict[str, np.ndarray]:
        found: dict[str, np.ndarray] = {}
        for prim in stage.Traverse():
            if not prim.IsA(UsdPhysics.Joint):
                continue
            joint, move = UsdPhysics.Joint(prim), np.eye(4)
            value = positions.get(prim.GetName(), 0.0)
            if prim.IsA(UsdPhysics.RevoluteJoint):
                move[:3, :3] = Rotation.from_euler("x", value).as_matrix()
            elif prim.IsA(UsdPhysics.PrismaticJoint):
                move[0, 3] = value
            parents = [found[path.name] for path in joint.GetBody0Rel().GetTargets()] or [np.eye(4)]
            (child,) = joint.GetBody1Rel().GetTargets()
            found[child.name] = parents[0] @ frame(joint, 0) @ move @ np.linalg.inv(frame(joint, 1))
            if not value:
                there = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath(child))
                np.testing.assert_allclose(found[child.name], np.array(there).T, atol=1e-6) if not positions else None
        return found

    return poses


@pytest.fixture(scope="module", params=list(SOURCES))
def exported(request: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path, Path, ExportReport]:
    folder = tmp_path_factory.mktemp("joints")
    batch = scenes(folder / "own", request.param, SOURCES[request.param])
    report = export(batch, folder / "out", ["mjcf", "urdf", "sdf", "drake", "usd", "npz", "worlds"])
    return request.param, folder / "own", folder / "out", report


def users(file: str, folder: Path) -> Poses:
    """The links of the user's own file, by MuJoCo and by Drake."""
    if file.endswith(".xml"):
        return in_mujoco(folder / file)
    return in_drake(folder / file, weld="back" if file.endswith("urdf") else "")


READERS: dict[str, Callable[[Path], Poses]] = {
    "mjcf": lambda out: in_mujoco(out / "scene_000" / "scene.xml", "cabinet_0/"),
    "sdf": lambda out: in_drake(out / "scene_000" / "world.sdf", "cabinet_0"),
    "drake": lambda out: in_drake(out / "scene_000" / "scene.dmd.yaml", "cabinet_0", package=out / "package.xml"),
    "urdf": lambda out: in_pybullet(out / "scene_000" / "objects.json"),
    "usd": lambda out: in_usd(out / "scene_000.usda"),
}


@pytest.mark.parametrize("form", list(READERS))
def test_links_move_as_those_of_the_users_file(exported: Any, form: str) -> None:
    """For any positions of the joints; at 0 the links are where the frozen asset has them."""
    file, own, out, _ = exported
    theirs, ours = users(file, own), READERS[form](out)
    asset, origin = load_library(own)["cabinet"], np.eye(4)
    origin[:3, 3] = import_report(own)["cabinet"].origin
    stands = np.eye(4)
    stands[:3, :3], stands[:3, 3] = Rotation.from_euler("z", np.float32(0.7)).as_matrix(), (1.2, 0.3, 0.0)
    rng, zero = np.random.default_rng(0), ZERO.get(file, {})
    links = {joint.name: joint.link for joint in asset.joints}
    assert set(links) == ({"hinge", "slide"} if file.endswith("sdf") else {"hinge", "slide", "lid"})
    first = theirs({name: zero.get(name, 0.0) for name in links})
    base = stands @ origin @ np.linalg.inv(first["back"])  # the world of the user's file
    at_zero = ours(dict.fromkeys(links, 0.0))
    for _ in range(3):
        positions = {"hinge": rng.uniform(-1.9, 0.1), "slide": rng.uniform(0.0, 0.2), "lid": rng.uniform(-3.0, 3.0)}
        positions = {name: positions[name] for name in links}
        moved = theirs({name: value + zero.get(name, 0.0) for name, value in positions.items()})
        found = ours(positions)
        for link in links.values():
            expected = base @ moved[link] @ np.linalg.inv(base @ first[link])
            np.testing.assert_allclose(found[link] @ np.linalg.inv(at_zero[link]), expected, atol=1e-6)


def test_the_bodies_are_the_frozen_asset_cut_in_pieces(exported: Any) -> None:
    asset = load_library(exported[1])["cabinet"]
    frames = [np.eye(4)]
    for joint in asset.joints:
        frames.append(frames[joint.parent] @ joint.pose)
    parts, points, moments = [], [], []
    for frame, body in zip(frames, asset.bodies, strict=True):
        parts += [part.vertices @ frame[:3, :3].T + frame[:3, 3] for part in body.fine]
        points.append(body.visual.vertices @ frame[:3, :3].T + frame[:3, 3])
        moments.append(body.mass * (frame[:3, :3] @ body.center_of_mass + frame[:3, 3]))
    order = sorted(parts, key=lambda part: part.sum())
    for found, expected in zip(order, sorted((p.vertices for p in asset.fine), key=lambda p: p.sum()), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    found, expected = (
        np.array(sorted(map(tuple, np.round(p, 6)))) for p in (np.concatenate(points), asset.visual.vertices)
    )
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert all(body.mass > 0 for body in asset.bodies)


def test_limits_damping_and_friction_are_those_of_the_file(exported: Any) -> None:
    mujoco = pytest.importorskip("mujoco")
    file, own, out, report = exported
    model = mujoco.MjModel.from_xml_path(str(out / "scene_000" / "scene.xml"))
    hinge, slide = model.joint("cabinet_0/hinge"), model.joint("cabinet_0/slide")
    np.testing.assert_allclose(hinge.range, [-1.9, 0.1])
    np.testing.assert_allclose(slide.range, [0.0, 0.2])
    assert (hinge.type[0], slide.type[0]) == (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    dof = hinge.dofadr[0]
    assert (model.dof_damping[dof], model.dof_frictionloss[dof]) == (0.3, 0.1)
    if file == "cabinet.urdf":
        door = model.body("cabinet_0/door").id
        assert model.body_mass[door] == 2.0
        np.testing.assert_allclose(np.sort(model.body_inertia[door]), [0.027, 0.06, 0.087], rtol=1e-6)
        assert not model.jnt_limited[model.joint("cabinet_0/lid").id]
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(out / "scene_000.usda"))
    prim = stage.GetPrimAtPath("/World/cabinet_0/joints/hinge")
    found = [prim.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")]
    np.testing.assert_allclose(np.radians(found), [-1.9, 0.1], rtol=1e-6)
    assert prim.GetAttribute("newton:damping").Get() == pytest.approx(np.radians(0.3))
    assert "PhysicsArticulationRootAPI" in stage.GetPrimAtPath("/World/cabinet_0/cabinet").GetAppliedSchemas()
    names = ", ".join(joint.name for joint in load_library(own)["cabinet"].joints)
    assert report.notes == (
        f"cabinet: its joints ({names}) move in mjcf, urdf, sdf, drake, usd and are frozen in npz, worlds",
    )
    kept = f"movable joints frozen at zero, and kept in exports: {names}"
    assert kept in import_report(own)["cabinet"].notes


def test_a_free_asset_stays_frozen_unless_its_scene_type_welds_it(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    free = scenes(tmp_path / "free", "cabinet.urdf", urdf(), "welded: false")
    report = export(free, tmp_path / "a", "mjcf")
    assert report.notes == ("cabinet: its joints (hinge, slide, lid) are frozen in mjcf, because it is not welded",)
    model = mujoco.MjModel.from_xml_path(str(report.scenes[0]["mjcf"]))
    assert (model.nbody, model.njnt) == (3, 1)
    assert "movable joints frozen at zero: hinge, slide, lid" in import_report(tmp_path / "free")["cabinet"].notes
    held = scenes(tmp_path / "held", "cabinet.urdf", urdf(), "welded: false", ("cabinet",))
    model = mujoco.MjModel.from_xml_path(str(export(held, tmp_path / "b", "mjcf").scenes[0]["mjcf"]))
    assert (model.nbody, model.njnt) == (6, 3)


def test_limits_may_be_infinite_in_all_spellings_of_a_number(tmp_path: Path) -> None:
    for low, high in (("-inf", "inf"), ("-INF", "+Infinity"), ("-1e16", "1e17")):
        scenes(tmp_path / "own", "cabinet.urdf", urdf(f'<limit lower="{low}" upper="{high}"/>'))
        assert load_library(tmp_path / "own")["cabinet"].joints[0].limits == (-np.inf, np.inf)


def test_scale_and_up_move_the_joints_with_the_asset(tmp_path: Path) -> None:
    scenes(tmp_path / "own", "cabinet.urdf", urdf(), "welded: true")
    plain = load_library(tmp_path / "own")["cabinet"]
    scenes(tmp_path / "own", "cabinet.urdf", urdf(), "welded: true, scale: 2, up: y")
    large = load_library(tmp_path / "own")["cabinet"]
    (hinge, slide, _), (wide, far, _) = plain.joints, large.joints
    assert (wide.limits, far.limits) == (hinge.limits, (0.0, 0.4))
    turn = Rotation.from_euler("x", np.pi / 2).as_matrix()
    np.testing.assert_allclose(wide.pose[:3, :3] @ wide.axis, turn @ hinge.pose[:3, :3] @ hinge.axis, atol=1e-12)
    np.testing.assert_allclose(
        far.pose[:3, 3] - wide.pose[:3, 3], 2 * turn @ (slide.pose - hinge.pose)[:3, 3], atol=1e-9
    )
    assert large.bodies[2].mass == pytest.approx(8 * plain.bodies[2].mass)


def test_links_may_have_the_names_that_exports_give(tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    pytest.importorskip("pydrake")
    text, found = urdf(), []
    for link in ("door", "tray", "lid"):
        new = {"door": "base", "tray": "cabinet", "lid": "__lid__"}[link]
        text = text.replace(f'name="{link}"', f'name="{new}"').replace(f'link="{link}"', f'link="{new}"')
    text = text.replace('name="slide"', 'name="cabinet_0_weld"')
    for number, words in enumerate((urdf(), text)):
        batch = scenes(tmp_path / f"own{number}", "cabinet.urdf", words)
        out = tmp_path / f"out{number}"
        report = export(batch, out, ["mjcf", "sdf", "drake"])
        found.append(mujoco.MjModel.from_xml_path(str(report.scenes[0]["mjcf"])))
        for file in ("world.sdf", "scene.dmd.yaml"):
            assert len(in_drake(out / "scene_000" / file, "cabinet_0", package=out / "package.xml")({})) == 4
    np.testing.assert_allclose(found[1].geom_aabb, found[0].geom_aabb, atol=1e-12)
    np.testing.assert_array_equal(found[1].body_mass, found[0].body_mass)
    names = [found[1].body(row).name.rpartition("/")[2] for row in range(2, found[1].nbody)]
    assert names == ["cabinet_0", "base_2", "cabinet_2", "_lid_"]


def test_an_export_of_other_links_is_refused(tmp_path: Path) -> None:
    export(scenes(tmp_path / "own", "cabinet.urdf", urdf()), tmp_path / "out", "mjcf")
    heavier = scenes(tmp_path / "own", "cabinet.urdf", urdf().replace('mass value="2"', 'mass value="2.5"'))
    with pytest.raises(InvalidInputError, match="holds an export of other scenes"):
        export(heavier, tmp_path / "out", "urdf")


BALL = '<joint name="b" type="{}"><parent link="back"/><child link="more"/>{}</joint><link name="more">' + shapes(
    '<sphere radius="0.02"/>', ""
)
BALL += "</link>"


@pytest.mark.parametrize(
    ("file", "text", "words"),
    [
        ("a.urdf", urdf(rest=BALL.format("floating", "")), "frozen at zero: b (floating)"),
        ("a.urdf", urdf(rest=BALL.format("planar", "")), "frozen at zero: b (planar)"),
        ("a.urdf", urdf(rest=BALL.format("continuous", '<mimic joint="lid"/>')), "frozen at zero: b (mimic)"),
        (
            "a.urdf",
            urdf(rest=BALL.format("revolute", '<limit lower="1" upper="2"/>')),
            "frozen at zero: b (its limits are 1 to 2, without 0)",
        ),
        ("a.urdf", urdf(rest=BALL.format("revolute", "<limit/>")), "frozen at zero: b (its limits are 0 to 0)"),
        (
            "a.urdf",
            urdf(rest=BALL.format("continuous", "").split("<link")[0] + '<link name="more"/>'),
            "b (it joins what",
        ),
        ("a.sdf", sdf(axis="<xyz>0 0 1</xyz><mimic joint='slide'/>"), "frozen at zero: hinge (mimic)"),
        ("a.sdf", sdf(more="<static>true</static>"), "frozen at zero: hinge (the file says static), slide (the file"),
        (
            "a.sdf",
            sdf(more='<joint name="c" type="revolute"><parent>tray</parent><child>door</child><axis/></joint>'),
            "frozen at zero: hinge (in a loop), c (in a loop)",
        ),
        ("a.xml", MJCF, "frozen at zero: ball (ball)"),
        (
            "a.xml",
            MJCF.replace('"slide" axis="0.6 -0.8 0" range="0 0.2"', '"slide"'),
            "slide (prismatic, without a lower",
        ),
    ],
)
def test_what_cannot_move_is_frozen_and_named(tmp_path: Path, file: str, text: str, words: str) -> None:
    batch = scenes(tmp_path / "own", file, text)
    assert words in str(import_report(tmp_path / "own")["cabinet"])
    export(batch, tmp_path / "out", "mjcf")


@pytest.mark.parametrize(
    ("hinge", "words"),
    [
        ("", "joint 'hinge' is revolute and has no <limit>; give it lower and upper, or make it continuous or fixed"),
        ('<limit lower="1" upper="-1"/>', "joint 'hinge' has a lower limit of 1 above its upper one of -1; exchange"),
        ('<limit lower="none"/>', "lower of joint 'hinge' is 'none', which is not numbers"),
        (
            '<limit upper="1"/><dynamics damping="inf"/>',
            "the axis [0.0, 0.0, 1.0], damping and friction (inf, 0.0)",
        ),
        ('<limit lower="-none.inf" upper="1"/>', "lower of joint 'hinge' is '-none.inf', which is not numbers"),
    ],
)
def test_wrong_limits_are_an_error_of_a_welded_asset(tmp_path: Path, hinge: str, words: str) -> None:
    scenes(tmp_path / "own", "a.urdf", urdf(hinge))
    with pytest.raises(CorruptFileError) as error:
        load_library(tmp_path / "own")
    assert words in str(error.value)
    if "none" not in hinge:  # a free asset is frozen anyway
        scenes(tmp_path / "own", "a.urdf", urdf(hinge), "welded: false")
        assert words in str(import_report(tmp_path / "own")["cabinet"])


def test_judges_follow_the_links(tmp_path: Path) -> None:
    """The friction of its joint holds the lid; without it the lid falls, and pushes the tray that it hangs on."""
    pytest.importorskip("mujoco")
    for friction, falls in (("1", False), ("0", True)):
        text = urdf().replace('friction="1"', f'friction="{friction}"').replace("0.6 0 0.8", "1 0 0")
        text = text.replace('xyz="0.05 0 0.02"', 'xyz="0 -0.1 0.02"')  # the lid, beside its axis
        batch = scenes(tmp_path / f"own{friction}", "cabinet.urdf", text)
        export(batch, tmp_path / friction, ["mjcf", "urdf", "npz"])
        faults = [(found.judge, fault) for found in verify(tmp_path / friction).findings for fault in found.faults]
        assert {fault.partition(":")[0] for _, fault in faults} == (
            {"cabinet_0/lid", "cabinet_0/tray"} if falls else set()
        )
        assert {judge for judge, _ in faults} <= {"MuJoCo, MJCF", "PyBullet, URDF"}
