"""Assets from MJCF and USD: our exports come back, other files agree with MuJoCo and closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import torch
import trimesh

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
    for words in (
        "movable joints frozen at zero: hinge",
        "'floor', a plane of body 'world', is left out",
        "not read: geom/@friction",
    ):
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


def test_our_usd_comes_back(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    ours = exported(tmp_path / "out", "usd")
    (scene,) = (tmp_path / "out").rglob("scene*.usda")
    for name, asset in ours.items():
        reference = f"""def "it" (prepend references = @{scene}@</World/{name}_0>) {{}}"""
        head = '#usda 1.0\n(\n    metersPerUnit = 1\n    upAxis = "Z"\n)\n'
        (tmp_path / "it.usda").write_text(head + reference)
        assert_same(listed(tmp_path, "it.usda", keys=", base: origin"), asset)


def usd(geometry: str, body: str = "", head: str = 'metersPerUnit = 1\n    upAxis = "Z"', rest: str = "") -> str:
    return f"""#usda 1.0
(
    {head}
)
def Xform "it" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])
{{
    {body}
    {geometry}
}}
{rest}
"""


CUBE = """def Cube "box" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMassAPI"])
    {{
        double size = 2
        double3 xformOp:scale = (0.1, 0.05, 0.02)
        uniform token[] xformOpOrder = ["xformOp:scale"]
        {}
    }}"""
BOX = np.array([0.2, 0.1, 0.04])


def box_moments(mass: float) -> np.ndarray:
    return mass / 12 * ((BOX**2).sum() - BOX**2)


@pytest.mark.parametrize(
    ("body", "collider", "mass"),
    [
        ("", "", 0.8),  # the default density of UsdPhysics, 1000 kg/m3
        ("float physics:density = 500", "", 0.4),
        ("float physics:density = 500", "float physics:density = 250", 0.2),
        ("float physics:density = 500", "float physics:mass = 3", 3.0),
        ("float physics:mass = 7", "float physics:mass = 3", 7.0),
    ],
)
def test_masses_of_usd_have_the_precedence_of_the_schema(tmp_path: Path, body: str, collider: str, mass: float) -> None:
    pytest.importorskip("pxr")
    asset = listed(tmp_path, "it.usda", usd(CUBE.format(collider), body))
    assert asset.mass == pytest.approx(mass, rel=1e-6)
    np.testing.assert_allclose(np.diag(asset.inertia), box_moments(mass), rtol=1e-6)


def test_units_up_axis_and_principal_axes_of_usd(tmp_path: Path) -> None:
    """In centimetres, y up: the box lies with its y side up, and the inertia turns with it."""
    pytest.importorskip("pxr")
    body = """float physics:mass = 2
    point3f physics:centerOfMass = (1, 0.5, 0)
    float3 physics:diagonalInertia = (20, 60, 70)
    quatf physics:principalAxes = (0.70710678, 0, 0, 0.70710678)"""
    cube = CUBE.format("").replace("(0.1, 0.05, 0.02)", "(10, 5, 2)")
    text = usd(cube, body, 'metersPerUnit = 0.01\n    upAxis = "Y"')
    asset = listed(tmp_path, "it.usda", text, ", base: origin")
    np.testing.assert_allclose(asset.bounds[1] - asset.bounds[0], [0.2, 0.04, 0.1], atol=1e-6)
    np.testing.assert_allclose(asset.center_of_mass, [0.01, 0, 0.005], atol=1e-8)
    np.testing.assert_allclose(asset.inertia, np.diag([60e-4, 70e-4, 20e-4]), atol=1e-8)


def test_what_usd_does_not_say_or_hold_is_refused_or_named(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    with pytest.raises(InvalidInputError, match="does not state `metersPerUnit`"):
        listed(tmp_path, "it.usda", usd(CUBE.format(""), head='upAxis = "Y"'))
    with pytest.raises(CorruptFileError, match="cannot be loaded"):
        listed(tmp_path, "it.usda", usd('def "lost" (references = @lost.usda@) {}'))
    with pytest.raises(CorruptFileError, match="cannot be read as USD"):
        listed(tmp_path, "it.usda", "no stage")
    second = 'def Cube "b" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI"]) {}'
    with pytest.raises(InvalidInputError, match="2 bodies"):
        listed(tmp_path, "it.usda", usd(CUBE.format(""), rest=second))
    hinge = """def PhysicsRevoluteJoint "hinge"
{
    rel physics:body0 = </it>
    rel physics:body1 = </b>
}"""
    asset = listed(tmp_path, "it.usda", usd(CUBE.format(""), rest=f"{second}\n{hinge}"))
    assert asset.mass == pytest.approx(0.8 + 8000)
    assert "movable joints frozen where they are: hinge" in said(tmp_path)


def test_a_file_that_mujoco_wrote_is_read(tmp_path: Path) -> None:
    """``usd_golden.usda`` of MuJoCo's test data, against the numbers in it."""
    pytest.importorskip("pxr")
    file = Path(mujoco.__file__).parent / "testdata" / "usd_golden.usda"
    if not file.is_file():
        pytest.skip("this MuJoCo has no test data")
    with pytest.raises(InvalidInputError, match="metersPerUnit"):
        listed(tmp_path, "it.usda", file.read_text())
    text = file.read_text().replace('upAxis = "Z"', 'upAxis = "Z"\n    metersPerUnit = 1', 1)
    asset = listed(tmp_path, "it.usda", text)
    np.testing.assert_allclose(asset.bounds[1] - asset.bounds[0], [2, 2, 2], atol=1e-9)
    assert asset.mass == pytest.approx(500 * 8)


def test_colours_of_usd_come_by_index_and_from_above_and_those_of_parts_are_named(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Sdf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "it.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    above = UsdGeom.PrimvarsAPI(UsdGeom.Xform.Define(stage, "/a"))
    above.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant").Set([(0, 1, 0)])
    meshes = [UsdGeom.Mesh.Define(stage, f"/a/{name}") for name in "mno"]
    for index, mesh in enumerate(meshes):
        mesh.CreatePointsAttr((trimesh.creation.box((0.1, 0.1, 0.1)).vertices + np.array([index, 0, 0])).tolist())
        mesh.CreateFaceVertexCountsAttr([3] * 12)
        mesh.CreateFaceVertexIndicesAttr(trimesh.creation.box().faces.ravel().tolist())
    own = meshes[0].CreateDisplayColorPrimvar("uniform")
    own.Set([(1, 0, 0), (0, 0, 1)])
    own.SetIndices([0, 0, 0, *[1] * 9])
    UsdGeom.Subset.CreateGeomSubset(meshes[1], "half", "face", [0, 1], "materialBind")
    stage.Save()
    asset = listed(tmp_path, "it.usda")
    counts = dict(zip(*np.unique(asset.visual.visual.face_colors @ [1, 2, 4, 0], return_counts=True), strict=True))
    assert counts == {255: 3, 4 * 255: 9, 2 * 255: 24}
    assert "not read: materials of parts of /a/n" in said(tmp_path)


def test_colours_of_faces_and_a_left_handed_mirrored_mesh(tmp_path: Path) -> None:
    """USD keeps linear colours: 0.2159 is 128 of 255 in sRGB. Faces of a mirror face outward again."""
    pytest.importorskip("pxr")
    box = """def Mesh "m" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI"])
    {
        uniform token orientation = "leftHanded"
        uniform token subdivisionScheme = "none"
        uniform token physics:approximation = "none"
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)]
        color3f[] primvars:displayColor = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1), (0, 0, 0), (0.2159, 0, 0)] (
            interpolation = "uniform"
        )
        double3 xformOp:scale = (-0.1, 0.2, 0.3)
        uniform token[] xformOpOrder = ["xformOp:scale"]
    }"""
    for text in (usd(box), usd(box.replace("-0.1", "0.1"))):
        asset = listed(tmp_path, "it.usda", text)
        assert asset.mass == pytest.approx(1000 * 0.1 * 0.2 * 0.3)
        shown = {tuple(color) for color in asset.visual.visual.vertex_colors[:, :3].tolist()}
        assert (128, 0, 0) in shown
        assert len(shown) == 6
        assert asset.visual.volume == pytest.approx(0.006)


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
@pytest.mark.parametrize("kind", ["Cylinder", "Capsule"])
def test_rods_of_usd_lie_along_their_axis(tmp_path: Path, kind: str, axis: str) -> None:
    pytest.importorskip("pxr")
    rod = f"""def {kind} "rod" (prepend apiSchemas = ["PhysicsCollisionAPI"])
    {{
        double radius = 0.05
        double height = 0.3
        uniform token axis = "{axis}"
    }}"""
    asset = listed(tmp_path, "it.usda", usd(rod, "float physics:density = 700"))
    ball = 4 / 3 * np.pi * 0.05**3 * (kind == "Capsule")
    assert asset.mass == pytest.approx(700 * (np.pi * 0.05**2 * 0.3 + ball), rel=1e-6)
    assert int(np.ptp(asset.bounds, axis=0).argmax()) == "XYZ".index(axis)
    assert int(np.diag(asset.inertia).argmin()) == "XYZ".index(axis)


def test_a_folder_takes_models_and_not_what_they_use(tmp_path: Path) -> None:
    import trimesh

    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "meshes" / "b.stl")
    text = '<mujoco><compiler meshdir="meshes"/><asset><mesh name="b" file="b.stl"/></asset><worldbody><body>'
    (tmp_path / "cup.xml").write_text(f'{text}<freejoint/><geom type="mesh" mesh="b"/></body></worldbody></mujoco>')
    (tmp_path / "package.xml").write_text("<package><name>p</name></package>")
    assert load_library(tmp_path).names == ("cup",)
    assert load_library(tmp_path)[0].mass == pytest.approx(1.0, rel=1e-6)  # MuJoCo's default density, 1000 kg/m3


def test_densities_of_materials_and_hulls_of_open_meshes(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    text = """def Material "oak" (prepend apiSchemas = ["PhysicsMaterialAPI"])
    {
        float physics:density = 700
        float physics:staticFriction = 0.4
    }
    def Mesh "tent" (prepend apiSchemas = ["PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "MaterialBindingAPI"])
    {
        uniform token physics:approximation = "convexHull"
        rel material:binding:physics = </it/oak>
        int[] faceVertexCounts = [3, 3, 3]
        int[] faceVertexIndices = [0, 1, 3, 1, 2, 3, 2, 0, 3]
        point3f[] points = [(0, 0, 0), (0.3, 0, 0), (0, 0.3, 0), (0, 0, 0.3)]
    }"""
    assert listed(tmp_path, "it.usda", usd(text)).mass == pytest.approx(700 * 0.3**3 / 6, rel=1e-6)
    assert "friction of materials" in said(tmp_path)


def test_points_that_place_prototypes_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    with pytest.raises(InvalidInputError, match="point instancer"):
        listed(tmp_path, "it.usda", usd('def PointInstancer "many" {}'))


def test_a_folder_leaves_out_what_an_mjcf_includes(tmp_path: Path) -> None:
    (tmp_path / "assets").mkdir()
    (tmp_path / "parts").mkdir()
    trimesh.creation.box((0.2, 0.1, 0.05)).export(tmp_path / "assets" / "b.stl")
    body = "<body><freejoint/><geom type='mesh' mesh='b'/></body>"
    head = "<compiler assetdir='assets'/><include file='parts/inc.xml'/>"
    (tmp_path / "cup.xml").write_text(f"<mujoco>{head}<worldbody>{body}</worldbody></mujoco>")
    (tmp_path / "parts" / "inc.xml").write_text("<mujoco><include file='parts/more.xml'/></mujoco>")
    (tmp_path / "parts" / "more.xml").write_text("<mujoco><asset><mesh file='b.stl'/></asset></mujoco>")
    (asset,) = load_library(tmp_path)
    assert asset.name == "cup"
    assert asset.mass == pytest.approx(1000 * 0.2 * 0.1 * 0.05)


def test_a_model_that_another_attaches_is_no_asset_and_joins_its_mass(tmp_path: Path) -> None:
    """By MuJoCo, which also strips the folders of its meshes."""
    trimesh.creation.box((0.2, 0.1, 0.05)).export(tmp_path / "b.stl")
    part = "<worldbody><body name='x'><geom type='mesh' mesh='b'/></body></worldbody>"
    (tmp_path / "lid.xml").write_text(f"<mujoco><asset><mesh file='far/b.stl'/></asset>{part}</mujoco>")
    body = "<freejoint/><geom type='box' size='.1 .1 .1'/><attach model='lid' body='x' prefix='p'/>"
    asset = "<compiler strippath='true'/><asset><model name='lid' file='lid.xml'/></asset>"
    (tmp_path / "cup.xml").write_text(f"<mujoco>{asset}<worldbody><body>{body}</body></worldbody></mujoco>")
    (cup,) = load_library(tmp_path)
    assert cup.name == "cup"
    assert cup.mass == pytest.approx(1000 * (0.2**3 + 0.2 * 0.1 * 0.05))


def test_textures_of_mjcf_are_not_opened(tmp_path: Path) -> None:
    """They are not read, so one that is lost costs nothing."""
    sides = " ".join(f"file{side}='lost.png'" for side in ("right", "left", "up", "down", "front", "back"))
    textures = f"<texture name='t' type='2d' file='lost.png'/><texture type='skybox' {sides}/>"
    head = f"<mujoco><asset>{textures}<material name='m' texture='t'/></asset><worldbody><body><freejoint/>"
    geom = "<geom type='box' size='.1 .1 .1' material='m'/>"
    asset = listed(tmp_path, "it.xml", f"{head}{geom}</body></worldbody></mujoco>")
    assert asset.mass == pytest.approx(8)
    assert "not read: asset/texture (2 times), material/@texture" in said(tmp_path)


def test_drag_of_a_free_joint_and_masks_of_geoms_are_named(tmp_path: Path) -> None:
    geom = "<geom type='box' size='.1 .1 .1' contype='4' conaffinity='2'/>"
    head = "<mujoco><default><joint damping='1'/></default><worldbody><body><joint type='free' frictionloss='1'/>"
    listed(tmp_path, "it.xml", f"{head}{geom}</body></worldbody></mujoco>")
    for words in ("damping of the free joint", "frictionloss of the free joint", "contype and conaffinity above 1"):
        assert words in said(tmp_path)


def test_a_face_beyond_the_vertices_is_named(tmp_path: Path) -> None:
    corners = "".join(f"v {x} {y} 0\n" for x in (0, 1) for y in (0, 1))
    with pytest.raises(CorruptFileError, match="a face refers to vertex -4 of 4"):
        listed(tmp_path, "it.obj", f"{corners}f -9 -3 -2 -1\n")
    with pytest.raises(CorruptFileError, match="a face refers to vertex 7 of 4"):
        listed(tmp_path, "it.obj", f"{corners}f 1 2 7 3\n")
