"""URDF and SDF models against closed forms and against Drake's reading of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene_envs.assets import Asset, import_report, load_library
from scene_envs.errors import CorruptFileError, InvalidInputError

HAMMER = """
<robot name="hammer">
  <material name="steel"><color rgba="0.4 0.4 0.5 1"/></material>
  <link name="handle">
    <inertial><mass value="0.3"/><inertia ixx="1e-3" iyy="1e-3" izz="5e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.03 0.02 0.2"/></geometry>
      <material name="wood"><color rgba="0.8 0.5 0.2 1"/></material></visual>
    <collision><geometry><box size="0.03 0.02 0.2"/></geometry></collision>
  </link>
  <link name="head">
    <inertial><origin xyz="0 0 0.01" rpy="0 0 0"/><mass value="0.5"/>
      <inertia ixx="3e-4" iyy="3e-4" izz="6e-5" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.02" length="0.08"/></geometry><material name="steel"/></visual>
    <collision><geometry><cylinder radius="0.02" length="0.08"/></geometry></collision>
  </link>
  <joint name="wedge" type="{joint}">
    <parent link="handle"/><child link="head"/>
    <origin xyz="0 0 0.12" rpy="1.5707963267948966 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
</robot>
"""

HAMMER_SDF = """
<sdf version="1.7"><world name="w"><model name="hammer"><pose>1 2 3 0 0 0.4</pose>
  <link name="handle">
    <inertial><mass>0.3</mass><inertia><ixx>1e-3</ixx><iyy>1e-3</iyy><izz>5e-5</izz></inertia></inertial>
    <visual name="v"><geometry><box><size>0.03 0.02 0.2</size></box></geometry></visual>
    <collision name="c"><geometry><box><size>0.03 0.02 0.2</size></box></geometry></collision>
  </link>
  <frame name="top" attached_to="handle"><pose>0 0 0.12 0 0 0</pose></frame>
  <link name="head"><pose relative_to="top" degrees="true">0 0 0 90 0 0</pose>
    <inertial><pose>0 0 0.01 0 0 0</pose><mass>0.5</mass>
      <inertia><ixx>3e-4</ixx><iyy>3e-4</iyy><izz>6e-5</izz></inertia></inertial>
    <collision name="c"><geometry><cylinder><radius>0.02</radius><length>0.08</length></cylinder></geometry></collision>
  </link>
  <joint name="wedge" type="fixed"><parent>handle</parent><child>head</child></joint>
</model></world></sdf>
"""


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))


def load(folder: Path, name: str, text: str, keys: str = "") -> Asset:
    (folder / name).write_text(text)
    (folder / "library.yaml").write_text(f"- {{file: {name}{keys}}}")
    return load_library(folder)[0]


def hammer_properties() -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass and inertia of the hammer by the parallel-axis theorem, handle frame."""
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # 90 degrees about x
    handle, head = np.zeros(3), np.array([0, 0, 0.12]) + turn @ [0, 0, 0.01]
    center = (0.3 * handle + 0.5 * head) / 0.8
    inertia = np.diag([1e-3, 1e-3, 5e-5]) + turn @ np.diag([3e-4, 3e-4, 6e-5]) @ turn.T
    for mass, place in ((0.3, handle), (0.5, head)):
        arm = place - center
        inertia += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return center, inertia


def test_links_are_merged_as_rigid_bodies_are(tmp_path: Path) -> None:
    asset = load(tmp_path, "hammer.urdf", HAMMER.format(joint="fixed"), ", base: origin")
    center, inertia = hammer_properties()
    assert asset.mass == pytest.approx(0.8)
    assert asset.center_of_mass == pytest.approx(center, abs=1e-12)
    assert asset.inertia == pytest.approx(inertia, abs=1e-12)
    assert asset.bounds[0] == pytest.approx([-0.02, -0.04, -0.1])  # the head lies along y at z = 0.12
    assert asset.bounds[1] == pytest.approx([0.02, 0.04, 0.14])
    assert len(asset.fine) == 2
    assert import_report(tmp_path)["hammer"].warnings == ()
    colors = np.unique(asset.visual.visual.vertex_colors[:, :3], axis=0).tolist()
    assert colors == [[102, 102, 128], [204, 128, 51]]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "text"), [("hammer.urdf", HAMMER.format(joint="fixed")), ("hammer.sdf", HAMMER_SDF)])
def test_drake_merges_them_alike(tmp_path: Path, name: str, text: str) -> None:
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    asset = load(tmp_path, name, text, ", base: origin")
    plant = MultibodyPlant(0.0)
    (model,) = Parser(plant).AddModels(str(tmp_path / name))
    plant.Finalize()
    frame = plant.GetFrameByName("handle", model)
    merged = plant.CalcSpatialInertia(plant.CreateDefaultContext(), frame, plant.GetBodyIndices(model))
    central = merged.Shift(merged.get_com())
    assert asset.mass == pytest.approx(merged.get_mass())
    assert asset.center_of_mass == pytest.approx(merged.get_com(), abs=1e-12)
    assert asset.inertia == pytest.approx(central.CalcRotationalInertia().CopyToFullMatrix3(), abs=1e-12)


def test_movable_joints_are_frozen_at_zero_and_that_is_said(tmp_path: Path) -> None:
    fixed = load(tmp_path, "a.urdf", HAMMER.format(joint="fixed"))
    frozen = load(tmp_path, "b.urdf", HAMMER.format(joint="revolute"))
    assert frozen.bounds == pytest.approx(fixed.bounds)
    assert "movable joints frozen at zero: wedge" in import_report(tmp_path)["b"].notes


def test_materials_without_a_name_keep_their_own_colors(tmp_path: Path) -> None:
    box = '<geometry><box size="0.1 0.1 0.1"/></geometry><material><color rgba="{}"/></material>'
    visuals = "".join(f"<visual>{box.format(rgba)}</visual>" for rgba in ("1 0 0 1", "0 0 1 1"))
    asset = load(tmp_path, "two.urdf", f'<robot name="two"><link name="a">{visuals}</link></robot>')
    colors = np.unique(asset.visual.visual.vertex_colors[:, :3], axis=0).tolist()
    assert colors == [[0, 0, 255], [255, 0, 0]]


def test_sdf_and_urdf_of_one_thing_agree(tmp_path: Path) -> None:
    """Poses relative to a frame, in degrees, and a model pose that is left out."""
    urdf = load(tmp_path, "a.urdf", HAMMER.format(joint="fixed"))
    sdf = load(tmp_path, "b.sdf", HAMMER_SDF)
    assert sdf.bounds == pytest.approx(urdf.bounds, abs=1e-9)
    assert sdf.center_of_mass == pytest.approx(urdf.center_of_mass, abs=1e-9)
    assert sdf.inertia == pytest.approx(urdf.inertia, abs=1e-12)


def test_scaling_keeps_the_material(tmp_path: Path) -> None:
    small = load(tmp_path, "a.urdf", HAMMER.format(joint="fixed"))
    large = load(tmp_path, "b.urdf", HAMMER.format(joint="fixed"), ", scale: 2")
    assert large.bounds == pytest.approx(2 * small.bounds)
    assert large.mass == pytest.approx(8 * small.mass)
    assert large.inertia == pytest.approx(32 * small.inertia)
    heavy = load(tmp_path, "c.urdf", HAMMER.format(joint="fixed"), ", scale: 2, mass: 0.8")
    assert heavy.inertia == pytest.approx(4 * small.inertia)


def primitive(shape: str, inertial: str = "") -> str:
    return (
        f'<robot name="r"><link name="l">{inertial}<collision><geometry>{shape}</geometry></collision></link></robot>'
    )


@pytest.mark.parametrize(
    ("shape", "size", "volume"),
    [
        ('<box size="0.1 0.06 0.04"/>', (0.1, 0.06, 0.04), 0.1 * 0.06 * 0.04),
        ('<cylinder radius="0.05" length="0.2"/>', (0.1, 0.1, 0.2), np.pi * 0.05**2 * 0.2),
        ('<sphere radius="0.05"/>', (0.0966, 0.0966, 0.1), 4 / 3 * np.pi * 0.05**3),
        ('<capsule radius="0.05" length="0.1"/>', (0.0966, 0.0966, 0.2), np.pi * 0.05**2 * (0.1 + 4 / 3 * 0.05)),
    ],
)
def test_primitives(tmp_path: Path, shape: str, size: tuple[float, ...], volume: float) -> None:
    asset = load(tmp_path, "p.urdf", primitive(shape), ", density: 1000")
    assert asset.bounds[1] - asset.bounds[0] == pytest.approx(size, abs=1e-4)
    assert asset.mass == pytest.approx(1000 * volume)
    assert asset.bounds[0, 2] == 0.0
    flat = [part.vertices[:, 2] == 0.0 for part in asset.fine]
    assert max(int(corners.sum()) for corners in flat) >= 3  # it can stand


def inertial(mass: float, xx: float, yy: float, zz: float, xyz: str = "0 0 0") -> str:
    return (
        f'<inertial><origin xyz="{xyz}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (inertial(0.5, 1, 1, 1), "times that of the shape"),
        (inertial(0.5, 2e-4, 6e-4, 0), "is not positive"),
        (inertial(0.5, 1e-4, 1e-4, 6e-4), "breaks the triangle inequality"),
        (inertial(0.5, 2.2e-4, 4.8e-4, 5.7e-4, "0 0 0.3"), "centre of mass (0, 0, 0.3) m lies outside"),
        (inertial(500.0, 2e-4, 6e-4, 7e-4), "500 kg would be 2.08e+06 kg/m^3"),
    ],
)
def test_inertia_that_cannot_be_is_recomputed_and_said(tmp_path: Path, given: str, reason: str) -> None:
    asset = load(tmp_path, "b.urdf", primitive('<box size="0.1 0.06 0.04"/>', given))
    mass = 0.5 if "500" not in given else 500 * 0.1 * 0.06 * 0.04
    assert asset.mass == pytest.approx(mass)
    expected = mass / 12 * np.array([0.06**2 + 0.04**2, 0.1**2 + 0.04**2, 0.1**2 + 0.06**2])
    assert np.diag(asset.inertia) == pytest.approx(expected)
    assert asset.center_of_mass == pytest.approx([0, 0, 0.02])
    (warning,) = import_report(tmp_path)["b"].warnings
    assert "recomputed" in warning
    assert reason in warning


def test_missing_inertia_is_computed_and_a_possible_one_is_kept(tmp_path: Path) -> None:
    asset = load(tmp_path, "a.urdf", primitive('<box size="0.1 0.06 0.04"/>'))
    assert asset.mass == pytest.approx(500 * 0.1 * 0.06 * 0.04)
    assert "computed from the shape at 500 kg/m^3: the file gives none" in str(import_report(tmp_path))
    kept = load(tmp_path, "b.urdf", primitive('<box size="0.1 0.06 0.04"/>', inertial(0.5, 3e-4, 4e-4, 5e-4)))
    assert np.diag(kept.inertia).tolist() == [3e-4, 4e-4, 5e-4]


def test_welded_by_the_file_and_by_the_user(tmp_path: Path) -> None:
    nothing = inertial(0.0, 0, 0, 0)
    shape = '<box size="0.1 0.06 0.04"/>'
    assert load(tmp_path, "a.urdf", primitive(shape, nothing)).static
    assert "welded" in str(import_report(tmp_path))
    free = load(tmp_path, "b.urdf", primitive(shape, nothing), ", welded: false")
    assert (free.static, free.mass) == (False, pytest.approx(500 * 0.1 * 0.06 * 0.04))
    assert not load(tmp_path, "c.urdf", primitive(shape, nothing), ", mass: 2").static
    welded = load(tmp_path, "d.urdf", primitive(shape, inertial(0.5, 3e-4, 4e-4, 5e-4)), ", welded: true")
    assert (welded.static, welded.mass) == (True, 0.0)
    assert not welded.inertia.any()


def test_meshes_are_found_by_package_scaled_and_mirrored(tmp_path: Path) -> None:
    package = tmp_path / "kitchen"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    wedge = trimesh.convex.convex_hull(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]))
    wedge.export(package / "meshes" / "wedge.stl")
    mesh = '<mesh filename="package://kitchen/meshes/wedge.stl" scale="-0.1 0.1 0.2"/>'
    asset = load(package / "urdf", "w.urdf", primitive(mesh), ", density: 600, base: origin")
    assert asset.bounds == pytest.approx(np.array([[-0.1, 0, 0], [0, 0.1, 0.2]]), abs=1e-7)
    assert asset.mass == pytest.approx(600 * 0.1 * 0.1 * 0.2 / 6)
    assert asset.visual.volume == pytest.approx(0.1 * 0.1 * 0.2 / 6)  # outside is outside


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.urdf", "<robot><link name='l'>", "not well-formed XML"),
        ("a.urdf", "<sdf/>", "its root is <sdf>, not <robot>"),
        ("a.urdf", "<robot/>", "holds no <link>"),
        ("a.urdf", "<robot><link name='l'/></robot>", "neither visual nor collision geometry"),
        ("a.urdf", primitive('<mesh filename="lost.obj"/>'), "refers to the mesh 'lost.obj', which does not exist in"),
        ("a.urdf", primitive('<mesh filename="package://p/lost.obj"/>'), "ROS_PACKAGE_PATH"),
        ("a.urdf", primitive('<box size="0.1 0.1"/>'), "must be 3 finite number(s), got '0.1 0.1'"),
        ("a.urdf", primitive('<box size="0.1 0.1 0"/>'), "must be above 0"),
        ("a.urdf", primitive('<sphere radius="${r}"/>'), "expand it with xacro first"),
        ("a.urdf", primitive("<blob/>"), "is a <blob>; known are mesh, box"),
        ("a.urdf", "<robot><link name='l'/><link name='m'/></robot>", "one root link, this one has 'l', 'm'"),
        (
            "a.urdf",
            "<robot><link name='l'/><joint name='j'><parent link='l'/><child link='m'/></joint></robot>",
            "joint 'j' connects link 'm', which does not exist",
        ),
        ("a.sdf", "<robot/>", "not an SDF"),
        ("a.sdf", "<sdf><model name='a'/><model name='b'/></sdf>", "holds 2 models ('a', 'b')"),
        ("a.sdf", "<sdf><world><include><uri>x</uri></include></world></sdf>", "includes are not followed"),
        ("a.sdf", "<sdf><model name='a'><link name='l'><pose relative_to='q'/></link></model></sdf>", "'q'"),
    ],
)
def test_a_wrong_model_names_the_file_and_the_reason(tmp_path: Path, name: str, text: str, message: str) -> None:
    with pytest.raises((CorruptFileError, InvalidInputError)) as caught:
        load(tmp_path, name, text)
    assert message in str(caught.value)
    assert str(tmp_path / name) in str(caught.value)


def test_prefixes_that_are_never_declared_are_tolerated(tmp_path: Path) -> None:
    trimesh.creation.annulus(0.03, 0.05, 0.02).export(tmp_path / "ring.stl")
    mesh = '<mesh filename="ring.stl"><drake:declare_convex/></mesh>'
    asset = load(tmp_path, "ring.urdf", primitive(mesh))
    assert len(asset.fine) == 1  # declared convex, so its hull
