"""Everything that a model refers to is loaded, named in the report or refused: against PyBullet, Drake, trimesh and
closed forms."""

from __future__ import annotations

import base64
import json
import re
import struct
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scene_envs.assets import Asset, import_report, load_library
from scene_envs.assets.importing.mesh_files import FORMATS, Y_UP, Model, cut_polygons, read_mesh
from scene_envs.assets.importing.robot_files import read_sdf, read_urdf, read_usd
from scene_envs.errors import CorruptFileError, InvalidInputError
from tests.helpers.model_files import BOX, POINTS, block, dae, gltf, triangles


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))


def listed(folder: Path, name: str, text: str | bytes, keys: str = "") -> Asset:
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    (folder / "library.yaml").write_text(f"- {{file: {name}, name: it{keys}}}")
    return load_library(folder)[0]


def said(folder: Path) -> str:
    return str(import_report(folder)["it"])


def sizes(asset: Asset) -> list[float]:
    return np.round(asset.bounds[1] - asset.bounds[0], 4).tolist()


def urdf(geometry: str, link: str = "", rest: str = "") -> str:
    body = f"<geometry>{geometry}</geometry>"
    return f'<robot name="r"><link name="l">{link}<collision>{body}</collision></link>{rest}</robot>'


def sdf(geometry: str, link: str = "", rest: str = "", collision: str = "") -> str:
    shape = f'<collision name="c">{collision}<geometry>{geometry}</geometry></collision>'
    return f'<sdf version="1.11"><model name="r"><link name="l">{link}{shape}</link>{rest}</model></sdf>'


# -- COLLADA --------------------------------------------------------------------------------------


@pytest.mark.parametrize("up", ["X_UP", "Y_UP", "Z_UP"])
def test_the_up_axis_of_a_dae_counts_for_itself_and_not_inside_a_model(tmp_path: Path, up: str) -> None:
    """As in RViz, Gazebo and PyBullet, which here gives the size of the same URDF."""
    pytest.importorskip("collada")
    text = dae(triangles(block()), block().vertices * 1000, up=up, meter="0.001")
    own = {"X_UP": [0.1, 0.04, 0.2], "Y_UP": [0.2, 0.04, 0.1], "Z_UP": [0.2, 0.1, 0.04]}[up]
    assert sizes(listed(tmp_path, "it.dae", text)) == own
    assert sizes(listed(tmp_path, "it.sdf", sdf("<mesh><uri>it.dae</uri></mesh>"))) == list(BOX)
    model = urdf('<mesh filename="it.dae"/>')
    assert sizes(listed(tmp_path, "it.urdf", model)) == list(BOX)
    bullet = pytest.importorskip("pybullet")
    client = bullet.connect(bullet.DIRECT)
    try:
        low, high = bullet.getAABB(bullet.loadURDF(str(tmp_path / "it.urdf"), physicsClientId=client), -1, client)
    finally:
        bullet.disconnect(client)
    assert np.subtract(high, low) == pytest.approx(BOX, abs=0.01)  # Bullet adds margins of a few millimetres


MATERIAL = (
    '<library_effects><effect id="e"><profile_COMMON>{extra}<technique sid="t"><phong><diffuse>{diffuse}</diffuse>'
    '</phong></technique></profile_COMMON></effect></library_effects><library_materials><material id="m">'
    '<instance_effect url="#e"/></material></library_materials>'
)
BIND = (
    '<bind_material><technique_common><instance_material symbol="x" target="#{}"/></technique_common></bind_material>'
)


@pytest.mark.parametrize(
    ("looks", "target", "words"),
    [
        (MATERIAL.format(extra="", diffuse="<color>0.9 0.1 0.1 1</color>"), "m", ""),
        (MATERIAL.format(extra="", diffuse="<color>red</color>"), "m", "cannot be read"),
        (
            MATERIAL.format(extra="", diffuse='<texture texture="lost" texcoord="u"/>'),
            "m",
            "its texture 'lost' is not there",
        ),
        (MATERIAL.format(extra="", diffuse="<color>0.9 0.1 0.1 1</color>"), "lost", "materials cannot be read"),
        (
            '<library_images><image id="i"><init_from>lost.png</init_from></image></library_images>'
            + MATERIAL.format(
                extra='<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>'
                '<newparam sid="w"><sampler2D><source>s</source></sampler2D></newparam>',
                diffuse='<texture texture="w" texcoord="u"/>',
            ),
            "m",
            "its texture 'lost.png' is not there",
        ),
    ],
)
def test_a_broken_look_of_a_dae_costs_no_geometry(tmp_path: Path, looks: str, target: str, words: str) -> None:
    pytest.importorskip("collada")
    text = dae(triangles(block(), 'material="x"'), block().vertices, looks=looks, bind=BIND.format(target))
    asset = listed(tmp_path, "it.dae", text)
    assert sizes(asset) == list(BOX)
    assert asset.mass == pytest.approx(500 * 0.2 * 0.1 * 0.04)
    assert words in said(tmp_path)
    if not words:
        assert np.unique(asset.visual.visual.vertex_colors[:, :3], axis=0).tolist() == [[230, 26, 26]]


# -- skins ----------------------------------------------------------------------------------------


def placed(angles: tuple[float, ...], place: tuple[float, ...]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", angles).as_matrix(), place
    return pose


FIRST, SECOND = placed((0.1, 0.2, 0.3), (0.5, 0, 0.2)), placed((0.7, 0, 0.2), (0, 0, 0.2))
BINDS = [np.linalg.inv(placed((0, 0, 0.1), (0, 0, -0.2))), np.linalg.inv(placed((0.1, 0, 0), (0, 0.05, 0)))]
ASIDE = placed((0.3, 0, 0), (3, 3, 3))  # pose of the node that holds the mesh, which a skin ignores
SHAPE = placed((0.2, 0, 0), (0.01, 0, 0))
ROD = trimesh.creation.box((0.2, 0.1, 0.4)).subdivide().subdivide()
SHARE = np.clip(ROD.vertices[:, 2] / 0.4 + 0.5, 0, 1).astype("<f4")  # weight of the second joint


def bent(shape: np.ndarray) -> trimesh.Trimesh:
    """The rod in closed form: the mean of what each joint makes of it."""
    moves = [joint @ bind @ shape for joint, bind in zip((FIRST, FIRST @ SECOND), BINDS, strict=True)]
    first, second = (trimesh.transform_points(ROD.vertices, move) for move in moves)
    return trimesh.Trimesh((1 - SHARE[:, None]) * first + SHARE[:, None] * second, ROD.faces, process=False)


def skinned_gltf(form: str) -> bytes:
    count = len(ROD.vertices)
    weights = np.stack([1 - SHARE, SHARE, 0 * SHARE, 0 * SHARE], axis=1)
    arrays = [
        (ROD.vertices.astype("<f4"), 5126, "VEC3"), (ROD.faces.astype("<u2").reshape(-1), 5123, "SCALAR"),
        (np.tile(np.array([0, 1, 0, 0], "u1"), (count, 1)), 5121, "VEC4"), (weights.astype("<f4"), 5126, "VEC4"),
        (np.array([bind.T for bind in BINDS], "<f4"), 5126, "MAT4"),
    ]  # fmt: skip
    data, views, accessors = b"", [], []
    for index, (array, kind, shape) in enumerate(arrays):
        data += bytes(-len(data) % 4)
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        accessors.append({"bufferView": index, "componentType": kind, "count": len(array), "type": shape})
        data += array.tobytes()
    nodes = [{"mesh": 0, "skin": 0, "matrix": ASIDE.T.ravel().tolist()}, {"matrix": FIRST.T.ravel().tolist()}]
    nodes[1]["children"], uri = [2], "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    primitive = {"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}, "indices": 1}
    header = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data)} | ({"uri": uri} if form == "gltf" else {})],
        "bufferViews": views, "accessors": accessors, "meshes": [{"name": "rod", "primitives": [primitive]}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": 4}], "scenes": [{"nodes": [0, 1]}],
        "nodes": [*nodes, {"matrix": SECOND.T.ravel().tolist()}],
    }  # fmt: skip
    text = json.dumps(header).encode()
    text, data = text + b" " * (-len(text) % 4), data + bytes(-len(data) % 4)
    head = struct.pack("<4s3I4s", b"glTF", 2, 28 + len(text) + len(data), len(text), b"JSON")
    return text if form == "gltf" else head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def skinned_dae() -> str:
    def row(values: Any) -> str:
        return " ".join(map(repr, np.ravel(values).tolist()))

    def source(name: str, kind: str, values: str, step: int, param: str) -> str:
        count = len(values.split())
        return (
            f'<source id="{name}"><{kind}_array id="{name}a" count="{count}">{values}</{kind}_array><technique_common>'
            f'<accessor source="#{name}a" count="{count // step}" stride="{step}"><param name="{param}" type="float"/>'
            "</accessor></technique_common></source>"
        )

    count = len(ROD.vertices)
    skin = f"""<library_controllers><controller id="k"><skin source="#g"><bind_shape_matrix>{row(SHAPE)}
</bind_shape_matrix>{source("kj", "Name", "a b", 1, "JOINT")}{source("kb", "float", row(BINDS), 16, "TRANSFORM")}
{source("kw", "float", row(np.stack([1 - SHARE, SHARE], axis=1)), 1, "WEIGHT")}<joints><input semantic="JOINT"
source="#kj"/><input semantic="INV_BIND_MATRIX" source="#kb"/></joints><vertex_weights count="{count}"><input
semantic="JOINT" source="#kj" offset="0"/><input semantic="WEIGHT" source="#kw" offset="1"/><vcount>{"2 " * count}
</vcount><v>{" ".join(f"0 {2 * i} 1 {2 * i + 1}" for i in range(count))}</v></vertex_weights></skin></controller>
</library_controllers>"""
    nodes = f"""<matrix>{row(ASIDE)}</matrix><instance_controller url="#k"><skeleton>#a</skeleton></instance_controller>
</node><node id="other"><node sid="a"/></node><node id="a" sid="a" type="JOINT"><matrix>{row(FIRST)}</matrix><node
sid="b" type="JOINT"><matrix>{row(SECOND)}</matrix></node>"""
    return dae(triangles(ROD), ROD.vertices.astype("<f4"), more=skin, node=nodes)


@pytest.mark.parametrize(
    ("form", "low", "high"),
    [
        ("gltf", [0.39507963, -0.23076328, 0.17537948], [0.74273872, 0.07163274, 0.55824341]),
        ("glb", [0.39507963, -0.23076328, 0.17537948], [0.74273872, 0.07163274, 0.55824341]),
        ("dae", [0.4007276, -0.24600523, 0.17066336], [0.75506969, 0.10769477, 0.53384486]),
    ],
)
def test_a_skinned_mesh_is_where_its_joints_put_it(
    tmp_path: Path, form: str, low: list[float], high: list[float]
) -> None:
    """As in closed form, and as the loaders of three.js 0.160 place it, whose bounds these are."""
    pytest.importorskip("collada")
    path = tmp_path / f"it.{form}"
    path.write_bytes(skinned_dae().encode() if form == "dae" else skinned_gltf(form))
    (mesh,) = read_mesh(path)
    expected = bent(SHAPE if form == "dae" else np.eye(4))
    np.testing.assert_allclose(expected.bounds, [low, high], atol=1e-7)
    turn = np.eye(3) if form == "dae" else Y_UP
    gaps, _ = cKDTree(expected.vertices @ turn.T).query(mesh.vertices)
    assert gaps.max() < 1e-6
    asset = listed(tmp_path, path.name, path.read_bytes(), ", decomposition: convex")
    assert asset.mass == pytest.approx(500 * expected.volume, rel=1e-5)
    assert "not" not in said(tmp_path).partition("%")[0].replace("the file gives none", "")


@pytest.mark.parametrize("is_instance", [False, True])
def test_a_skinned_mesh_of_usd_is_where_its_joints_put_it(tmp_path: Path, is_instance: bool) -> None:
    pytest.importorskip("pxr")
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel

    def matrix(pose: np.ndarray) -> Any:
        return Gf.Matrix4d(*pose.T.ravel().tolist())

    path = tmp_path / "it.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    place = "/_rod" if is_instance else "/rod"
    root, skeleton = UsdSkel.Root.Define(stage, place), UsdSkel.Skeleton.Define(stage, f"{place}/bones")
    root.GetPrim().SetSpecifier(Sdf.SpecifierClass if is_instance else Sdf.SpecifierDef)
    skeleton.CreateJointsAttr(["a", "a/b"])
    skeleton.CreateBindTransformsAttr([matrix(np.linalg.inv(bind)) for bind in BINDS])
    skeleton.CreateRestTransformsAttr([matrix(FIRST), matrix(SECOND)])
    mesh = UsdGeom.Mesh.Define(stage, f"{place}/mesh")
    mesh.AddTransformOp().Set(matrix(ASIDE))
    mesh.CreatePointsAttr(ROD.vertices.tolist())
    mesh.CreateFaceVertexCountsAttr([3] * len(ROD.faces))
    mesh.CreateFaceVertexIndicesAttr(ROD.faces.ravel().tolist())
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(matrix(SHAPE))
    binding.CreateJointIndicesPrimvar(False, 2).Set([0, 1] * len(ROD.vertices))
    binding.CreateJointWeightsPrimvar(False, 2).Set(np.stack([1 - SHARE, SHARE], axis=1).ravel().tolist())
    if is_instance:
        prim = stage.DefinePrim("/rod")
        prim.GetReferences().AddInternalReference(place)
        prim.SetInstanceable(True)
    stage.Save()
    (shape,) = read_usd(path).visuals
    expected = bent(SHAPE)
    np.testing.assert_allclose(shape.surface.vertices, expected.vertices, atol=1e-6)
    asset = listed(tmp_path, "it.usda", path.read_text(), ", decomposition: convex, mass: 2")
    np.testing.assert_allclose(asset.inertia, expected.moment_inertia * (2 / expected.volume), rtol=1e-4, atol=1e-7)


def test_skins_of_other_notations_are_the_same(tmp_path: Path) -> None:
    """Two sets of influences, whose weights then add up to 2, and joints by id."""
    pytest.importorskip("collada")
    expected = bent(np.eye(4)).vertices @ Y_UP.T
    file = json.loads(skinned_gltf("gltf"))
    attributes = file["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_1": attributes["JOINTS_0"], "WEIGHTS_1": attributes["WEIGHTS_0"]}
    (tmp_path / "it.gltf").write_text(json.dumps(file))
    np.testing.assert_allclose(read_mesh(tmp_path / "it.gltf")[0].vertices, expected, atol=1e-6)
    plain, found = skinned_dae(), []
    ids = plain.replace("Name_array", "IDREF_array").replace(">a b<", ">a n2<")
    for text in (plain, ids.replace('<node\nsid="b"', '<node id="n2" sid="c"')):
        assert text == plain or "n2" in text.partition("<library_visual")[2]
        (tmp_path / "it.dae").write_text(text)
        found.append(read_mesh(tmp_path / "it.dae")[0].vertices)
    np.testing.assert_array_equal(*found)


def test_a_corner_without_a_joint_keeps_its_bind_shape_and_morphs_are_named(tmp_path: Path) -> None:
    pytest.importorskip("collada")
    text = re.sub(r"<v>.*</v>", lambda match: match[0].replace("0 ", "-1 ", 1), skinned_dae())
    (tmp_path / "it.dae").write_text(text)  # -1 is the bind shape: the first corner has all its weight there
    first = SHARE[0] * trimesh.transform_points(ROD.vertices[:1], FIRST @ SECOND @ BINDS[1] @ SHAPE)
    first += (1 - SHARE[0]) * trimesh.transform_points(ROD.vertices[:1], SHAPE)
    assert cKDTree(read_mesh(tmp_path / "it.dae")[0].vertices).query(first)[0][0] < 1e-6
    sources = """<source id="mt"><IDREF_array id="mta" count="1">g</IDREF_array><technique_common><accessor
source="#mta" count="1"><param name="MORPH_TARGET" type="IDREF"/></accessor></technique_common></source><source id="mw">
<float_array id="mwa" count="1">0</float_array><technique_common><accessor source="#mwa" count="1"><param
name="MORPH_WEIGHT" type="float"/></accessor></technique_common></source>"""
    targets = '<input semantic="MORPH_TARGET" source="#mt"/><input semantic="MORPH_WEIGHT" source="#mw"/>'
    morph = f'<morph source="#g">{sources}<targets>{targets}</targets></morph>'
    more = f'<library_controllers><controller id="k">{morph}</controller></library_controllers>'
    node = '<instance_controller url="#k"/>'
    asset = listed(tmp_path, "it.dae", dae(triangles(block()), block().vertices, more=more, node=node))
    assert sizes(asset) == list(BOX)
    assert "its morph targets are not applied" in said(tmp_path)


def test_what_a_skin_lacks_is_named(tmp_path: Path) -> None:
    pytest.importorskip("collada")
    file = json.loads(skinned_gltf("gltf"))
    (tmp_path / "it.gltf").write_text(json.dumps({**file, "scenes": [{"nodes": [0]}]}))
    with pytest.raises(CorruptFileError, match=r"the nodes \[1, 2\], joints of a skin, are not in its scene"):
        read_mesh(tmp_path / "it.gltf")
    del file["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"]
    (tmp_path / "it.gltf").write_text(json.dumps(file))
    with pytest.raises(InvalidInputError, match="a skin without joints or weights"):
        read_mesh(tmp_path / "it.gltf")
    (tmp_path / "it.dae").write_text(skinned_dae().replace(">a b<", ">a c<"))
    with pytest.raises(CorruptFileError, match="the joint 'c' of the skin 'k' is not in its scene"):
        read_mesh(tmp_path / "it.dae")


# -- polygons -------------------------------------------------------------------------------------

U_SHAPE = np.array(
    [(-0.1, 0), (0.1, 0), (0.1, 0.1), (0.09, 0.1), (0.09, 0.01), (-0.09, 0.01), (-0.09, 0.1), (-0.1, 0.1)]
)
AREA = 0.2 * 0.01 + 2 * 0.01 * 0.09


def channel(outline: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """A prism (V, 3) of an outline in x and z, and its polygons; the ends are polygons of all corners."""
    count = len(outline)
    points = np.concatenate([np.column_stack([outline[:, 0], np.full(count, y), outline[:, 1]]) for y in (-0.08, 0.08)])
    sides = [[i, i + count, (i + 1) % count + count, (i + 1) % count] for i in range(count)]
    return points, [list(range(count)), list(range(count, 2 * count))[::-1], *sides]


@pytest.mark.parametrize("kind", ["obj", "relative.obj", "off", "ply", "dae", "polygons.dae"])
@pytest.mark.parametrize("shift", range(0, 8, 3))
def test_concave_polygons_keep_their_area_and_mass(tmp_path: Path, kind: str, shift: int) -> None:
    """A U of 8 corners, begun at different ones: the closed form of its area and volume."""
    points, polygons = channel(np.roll(U_SHAPE, shift, axis=0))
    if kind.endswith("dae"):
        pytest.importorskip("collada")
        given = '<input semantic="VERTEX" source="#v" offset="0"/>'
        runs = [" ".join(map(str, polygon)) for polygon in polygons]
        primitive = f'<polylist count="{len(runs)}">{given}<vcount>{" ".join(str(len(p)) for p in polygons)}</vcount>'
        text = dae(f"{primitive}<p>{' '.join(runs)}</p></polylist>", points)
        if kind == "polygons.dae":
            inner = "".join(f"<p>{run}</p>" for run in runs)
            text = dae(f'<polygons count="{len(runs)}">{given}{inner}</polygons>', points)
    elif kind in ("off", "ply"):
        rows = [" ".join(map(str, [len(polygon), *polygon])) for polygon in polygons]
        rows = [*(" ".join(map(str, point)) for point in points.tolist()), *rows]
        head = f"OFF\n{len(points)} {len(polygons)} 0"
        if kind == "ply":
            head = "\n".join(
                [
                    f"ply\nformat ascii 1.0\nelement vertex {len(points)}",
                    *(f"property double {axis}" for axis in "xyz"),
                    f"element face {len(polygons)}\nproperty list uchar int vertex_indices\nend_header",
                ]
            )
        text = "\n".join([head, *rows])
    else:
        offset = 1 if kind == "obj" else -len(points)
        faces = ["f " + " ".join(str(i + offset) for i in polygon) for polygon in polygons]
        text = "\n".join([*("v " + " ".join(map(str, point)) for point in points.tolist()), *faces])
        text += "\nv 9 9 9\n"  # relative indices count from the face
    asset = listed(tmp_path, f"it.{kind}", text, ", decomposition: convex")
    outline = np.linalg.norm(np.roll(U_SHAPE, -1, axis=0) - U_SHAPE, axis=1).sum()
    assert asset.visual.area == pytest.approx(2 * AREA + 0.16 * outline)
    assert asset.mass == pytest.approx(500 * AREA * 0.16)


def test_polygons_of_any_shape_are_covered_once() -> None:
    """Random stars with straight corners, turned in space: areas by the shoelace formula, no triangle without area."""
    generator = np.random.default_rng(0)
    for seed in range(60):
        count = int(generator.integers(4, 16))
        angles = (np.arange(count) + generator.uniform(0, 0.8, count)) * 2 * np.pi / count
        star = generator.uniform(0.3, 1, count)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        star = np.insert(star, 1, star[:2].mean(axis=0), axis=0)
        x, y = star.T
        area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        ring = np.column_stack([star, np.zeros(len(star))]) @ Rotation.random(rng=seed).as_matrix().T
        cut, _ = cut_polygons(ring, np.arange(len(ring)), np.array([len(ring)]))
        corners = ring[cut]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        assert len(cut) == len(ring) - 2
        assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(area)
        assert np.linalg.norm(normals.sum(axis=0)) == pytest.approx(area)  # all face the same side
        assert np.linalg.norm(normals, axis=1).min() > 1e-9


# -- OBJ and glTF ---------------------------------------------------------------------------------


def test_what_an_obj_names_and_does_not_have_is_in_the_report(tmp_path: Path) -> None:
    lines = [
        *(f"v {x} {y} {z}" for x, y, z in block().vertices),
        *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in block().faces),
    ]
    (tmp_path / "a.mtl").write_text("newmtl skin\nmap_Kd lost.png\n")
    listed(tmp_path, "it.obj", "\n".join(["mtllib a.mtl", "mtllib b.mtl", *lines, "l 1 2"]))
    for words in (
        "its texture 'lost.png' is not there",
        "material file 'b.mtl' is not read",
        "points, lines and curves",
    ):
        assert words in said(tmp_path)
    listed(tmp_path, "it.obj", "\n".join(["mtllib lost.mtl", *lines]))
    assert "its material file 'lost.mtl' is not there" in said(tmp_path)


def write_gltf(folder: Path, points: np.ndarray, faces: np.ndarray, **changes: Any) -> Asset:
    header, data = gltf(points, faces, **changes)
    (folder / "it.bin").write_bytes(data)
    return listed(folder, "it.gltf", header)


@pytest.mark.parametrize("kind", ["<i2", "i1", "u1", "<f4"])
def test_quantised_positions_are_scaled(tmp_path: Path, kind: str) -> None:
    """The node takes the steps of integers back to metres, as gltfpack writes it."""
    dtype = np.dtype(kind)
    half = np.array([0.1, 0.02, 0.05])  # y up in the file
    corners = block().vertices[:, [0, 2, 1]] / half
    most = 1 if dtype.kind == "f" else np.iinfo(dtype).max
    low = 0 if dtype.kind == "u" else -1
    points = np.zeros((8, 4), dtype=dtype)[:, : 3 if dtype.kind == "f" else 4]
    points[:, :3] = np.rint((corners + 1) / 2 * (most - low * most) + low * most)
    scale = 2 * half / (1 - low)
    node = {"mesh": 0, "scale": scale.tolist()}
    asset = write_gltf(tmp_path, points, block().faces, nodes=[node], extensionsRequired=["KHR_mesh_quantization"])
    assert sizes(asset) == list(BOX)
    assert asset.mass == pytest.approx(0.4)


def _as_glb(header: bytes, data: bytes) -> bytes:
    header += b" " * (-len(header) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(header), b"JSON") + header + struct.pack("<I4s", len(data), b"BIN\0") + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def test_a_glb_has_the_nodes_of_its_scene(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "children": [1, 2]}, {"mesh": 0, "translation": [0.2, 0, 0]}, {"camera": 0}]
    cameras = [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.01}}]
    points = block().vertices[:, [0, 2, 1]].astype("<f4")
    header, data = gltf(points, block().faces, nodes=nodes, cameras=cameras)
    parsed = json.loads(header)
    del parsed["buffers"][0]["uri"]
    assert sizes(listed(tmp_path, "it.glb", _as_glb(json.dumps(parsed).encode(), data))) == [0.4, 0.1, 0.04]
    apart = write_gltf(tmp_path, points, block().faces, nodes=[*nodes, {"mesh": 0, "translation": [5, 0, 0]}])
    assert sizes(apart) == [0.4, 0.1, 0.04]
    assert "1 node(s) outside its scene are left out" in said(tmp_path)


PRIMITIVE = {"attributes": {"POSITION": 0}, "indices": 1}
INSTANCED = [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}}]
SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5123}, "values": {"bufferView": 0}}
BARE = {"componentType": 5126, "count": 8, "type": "VEC3"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "EXT_meshopt_compression"),
        ({"nodes": [{"mesh": 0, "camera": 0}]}, "a mesh below a camera"),
        ({"scenes": []}, "no scene"),
        ({"nodes": INSTANCED}, "EXT_mesh_gpu_instancing"),
        ({"meshes": [{"primitives": [{**PRIMITIVE, "mode": 5}]}]}, "triangle strips or fans"),
        ({"meshes": [{"primitives": [{**PRIMITIVE, "mode": 6}]}]}, "triangle strips or fans"),
        ({"accessors": [{**BARE, "sparse": SPARSE}, BARE]}, "sparse accessors"),
        (
            {
                "accessors": [BARE, BARE],
                "meshes": [{"primitives": [{**PRIMITIVE, "extensions": {"KHR_draco_mesh_compression": {}}}]}],
            },
            "KHR_draco_mesh_compression",
        ),
    ],
)
def test_geometry_of_gltf_that_cannot_be_read_is_refused_by_its_name(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidInputError, match=f"it.gltf holds {words}, which cannot be read; export it without"):
        write_gltf(tmp_path, POINTS, block().faces, **changes)


def test_what_a_gltf_holds_besides_its_geometry_is_named(tmp_path: Path) -> None:
    write_gltf(
        tmp_path,
        POINTS,
        block().faces,
        extensionsUsed=["KHR_texture_transform", "VENDOR_thing", "KHR_materials_unlit"],
        animations=[],
        nodes=[{"mesh": 0, "weights": [1.0]}],
        images=[{"uri": "lost.png"}],
    )
    text = said(tmp_path)
    for name in ("KHR_texture_transform", "VENDOR_thing", "animations", "morph targets"):
        assert f"its {name} is not applied" in text
    assert "its texture 'lost.png' is not there" in text
    assert "unlit" not in text


# -- PLY, OFF, STL --------------------------------------------------------------------------------

CORNERS = "\n".join(" ".join(map(str, row)) for row in block().vertices.tolist())
FACES = "\n".join(f"3 {a} {b} {c}" for a, b, c in block().faces.tolist())


def ply(element: str = "", rows: str = "", comment: str = "") -> str:
    head = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = "element face 12\nproperty list uchar int vertex_indices\n"
    head = f"ply\nformat ascii 1.0\n{comment}element vertex 8\n{head}{faces}{element}end_header"
    return f"{head}\n{CORNERS}\n{FACES}\n{rows}"


def off(kind: str, corner: str = "", face: str = "") -> str:
    corners, faces = (text.replace("\n", f"{more}\n") + more for text, more in ((CORNERS, corner), (FACES, face)))
    return f"{kind}OFF\n8 12 0\n{corners}\n{faces}\n"


def stl(head: bytes = b"", behind: bytes = bytes(2)) -> bytes:
    data = bytearray(block().export(file_type="stl"))
    data[: len(head)] = head
    data[84 + 48 : 84 + 50] = behind
    return bytes(data)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("it.ply", ply(), ""),
        ("it.ply", ply("element tristrips 1\nproperty list int int vertex_indices\n", "3 0 1 2\n"), "'tristrips'"),
        ("it.ply", ply("element edge 1\nproperty int vertex1\nproperty int vertex2\n", "0 1\n"), "'edge' are left"),
        ("it.ply", ply(comment="comment TextureFile lost.png\n"), "its texture 'lost.png' is not there"),
        ("it.off", off(""), ""),
        ("it.off", off("C", " 255 0 0 255"), "its colours, normals and texture coordinates are not read"),
        ("it.off", off("N", " 0 0 1"), "its colours, normals and texture coordinates are not read"),
        ("it.off", off("", "", " 255 0 0"), "its colours, normals and texture coordinates are not read"),
        ("it.stl", stl(), ""),
        ("it.stl", stl(b"COLOR=\xff\x00\x00\xff"), "its colours are not read"),
        ("it.stl", stl(behind=b"\x1f\x80"), "its colours are not read"),
    ],
)  # fmt: skip
def test_what_a_simple_mesh_file_holds_besides_its_triangles_is_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str | bytes, words: str
) -> None:
    asset = listed(tmp_path, name, text)
    assert asset.mass == pytest.approx(500 * 0.2 * 0.1 * 0.04)
    assert words in said(tmp_path)
    assert words or "not" not in said(tmp_path).partition("%")[0]
    assert capfd.readouterr() == ("", "")


def test_points_of_four_dimensions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"it\.off is a 4OFF"):
        listed(tmp_path, "it.off", off("4", " 1"))


# -- closed bodies --------------------------------------------------------------------------------


def at(mesh: trimesh.Trimesh, *place: float, reversed: bool = False) -> trimesh.Trimesh:
    mesh = mesh.copy()
    mesh.apply_translation(place or (0, 0, 0))
    if reversed:
        mesh.invert()
    return mesh


def box_moments(size: tuple[float, float, float], density: float) -> np.ndarray:
    squares = density * np.prod(size) / 12 * np.square(size)
    return np.asarray(squares.sum() - squares)


@pytest.mark.parametrize("flips", list(product([False, True], repeat=2)))
def test_bodies_apart_weigh_what_they_hold_whatever_way_they_face(tmp_path: Path, flips: tuple[bool, bool]) -> None:
    one, two = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.05, 0.05, 0.05))
    whole = at(one, reversed=flips[0]) + at(two, 0.3, 0, 0, reversed=flips[1])
    asset = listed(tmp_path, "it.stl", whole.export(file_type="stl"), ", base: origin")
    true = (one + at(two, 0.3, 0, 0)).mass_properties  # of trimesh
    assert asset.mass == pytest.approx(500 * (0.1**3 + 0.05**3), rel=1e-5)
    assert np.diag(asset.inertia) == pytest.approx(500 * np.diag(true.inertia), rel=1e-4)
    assert asset.center_of_mass == pytest.approx(true.center_mass, abs=1e-6)


@pytest.mark.parametrize("outer_reversed", [False, True])
@pytest.mark.parametrize("inner", [-1.0, 1.0])
def test_a_cavity_is_empty_and_a_solid_in_a_solid_adds_its_mass(
    tmp_path: Path, outer_reversed: bool, inner: float
) -> None:
    """As in trimesh and MuJoCo; but these give the negative mass where all faces point inward."""
    outer, hole = (0.2, 0.16, 0.12), (0.12, 0.1, 0.08)
    turned = outer_reversed != (inner < 0)
    whole = at(trimesh.creation.box(outer), reversed=outer_reversed) + at(trimesh.creation.box(hole), reversed=turned)
    asset = listed(tmp_path, "it.stl", whole.export(file_type="stl"))
    assert asset.mass == pytest.approx(500 * (np.prod(outer) + inner * np.prod(hole)), rel=1e-5)
    assert asset.mass == pytest.approx(500 * abs(whole.volume), rel=1e-5)
    expected = box_moments(outer, 500) + inner * box_moments(hole, 500)
    assert np.diag(asset.inertia) == pytest.approx(expected, rel=1e-4)


def test_a_ball_in_a_cavity_counts_and_mixed_faces_are_turned(tmp_path: Path) -> None:
    shell = trimesh.creation.box((0.2, 0.2, 0.2)) + at(trimesh.creation.box((0.16, 0.16, 0.16)), reversed=True)
    whole = shell + trimesh.creation.box((0.1, 0.1, 0.1))
    asset = listed(tmp_path, "it.stl", whole.export(file_type="stl"))
    assert asset.mass == pytest.approx(500 * (0.2**3 - 0.16**3 + 0.1**3), rel=1e-5)
    mixed = block()
    mixed.faces[[1, 4, 7]] = mixed.faces[[1, 4, 7]][:, ::-1]
    assert not mixed.is_winding_consistent
    asset = listed(tmp_path, "it.stl", mixed.export(file_type="stl"))
    assert asset.mass == pytest.approx(0.4, rel=1e-5)
    assert np.diag(asset.inertia) == pytest.approx(box_moments(BOX, 500), rel=1e-4)


def test_plates_apart_are_one_body(tmp_path: Path) -> None:
    """Two plates without thickness span a volume together, and no body is closed."""
    plate = trimesh.Trimesh([(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)], [(0, 1, 2), (0, 2, 3)])
    whole = plate + at(plate, 0, 0, 0.05)
    asset = listed(tmp_path, "it.stl", whole.export(file_type="stl"), ", decomposition: convex")
    assert asset.mass == pytest.approx(500 * 0.1 * 0.1 * 0.05, rel=1e-5)
    assert len(listed(tmp_path, "it.stl", whole.export(file_type="stl")).fine) == 1


def test_a_body_that_is_split_by_material_is_whole(tmp_path: Path) -> None:
    points, polygons = channel(U_SHAPE)
    faces = ["f " + " ".join(str(i + 1) for i in polygon) for polygon in polygons]
    rows = ["v " + " ".join(map(str, point)) for point in points.tolist()]
    (tmp_path / "it.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\n")
    text = "\n".join(["mtllib it.mtl", *rows, "usemtl a", *faces[:5], "usemtl b", *faces[5:]])
    asset = listed(tmp_path, "it.obj", text, ", decomposition: convex")
    assert asset.mass == pytest.approx(500 * AREA * 0.16)
    assert len(np.unique(asset.visual.visual.vertex_colors, axis=0)) == 2


# -- models ---------------------------------------------------------------------------------------

TWO = "".join(
    f"o {name}\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in mesh.vertices) + "".join(
        f"f {a} {b} {c}\n" for a, b, c in mesh.faces + start
    )
    for name, mesh, start in (
        ("large", trimesh.creation.box((0.4, 0.4, 0.4)), 1),
        ("large_small", at(trimesh.creation.box((0.1, 0.1, 0.1)), 0.5, 0, 0), 9),
    )
)  # fmt: skip


def submesh(name: str, center: str = "false") -> str:
    return f"<mesh><uri>two.obj</uri><submesh><name>{name}</name><center>{center}</center></submesh></mesh>"


def test_a_submesh_is_one_object_of_its_file(tmp_path: Path) -> None:
    (tmp_path / "two.obj").write_text(TWO)
    for name, side in (("large", 0.4), ("large_small", 0.1)):
        assert sizes(listed(tmp_path, "it.sdf", sdf(submesh(name)))) == [side] * 3
    keep = ", base: origin"
    assert listed(tmp_path, "it.sdf", sdf(submesh("large_small")), keep).bounds[0, 0] == pytest.approx(0.45)
    assert listed(tmp_path, "it.sdf", sdf(submesh("large_small", "1")), keep).bounds[0, 0] == pytest.approx(-0.05)
    with pytest.raises(InvalidInputError, match=r"two.obj holds no object 'lost', the submesh of .*'large'"):
        listed(tmp_path, "it.sdf", sdf(submesh("lost")))


BALL = 4 / 3 * np.pi


@pytest.mark.parametrize(
    ("shape", "volume", "moments"),
    [
        ("<box><size>0.2 0.1 0.04</size></box>", np.prod(BOX), box_moments(BOX, 1)),
        ("<sphere><radius>0.1</radius></sphere>", BALL * 1e-3, [BALL * 1e-3 * 0.4 * 0.01] * 3),
        (
            "<ellipsoid><radii>0.1 0.05 0.02</radii></ellipsoid>",
            BALL * 1e-4,
            BALL * 1e-4 / 5 * np.array([0.0029, 0.0104, 0.0125]),
        ),
        (
            "<cylinder><radius>0.05</radius><length>0.2</length></cylinder>",
            np.pi * 5e-4,
            np.pi * 5e-4 * np.array([(0.0075 + 0.04) / 12, (0.0075 + 0.04) / 12, 0.00125]),
        ),
        ("<capsule><radius>0.05</radius><length>0.2</length></capsule>", np.pi * 5e-4 + BALL * 1.25e-4, None),
        ("<mesh><uri>it.stl</uri></mesh>", np.prod(BOX), box_moments(BOX, 1)),
    ],
)
def test_automatic_inertia_fills_the_shape_with_its_density(
    tmp_path: Path, shape: str, volume: float, moments: Any
) -> None:
    block().export(tmp_path / "it.stl")
    if moments is None:  # a fine mesh of trimesh
        mesh = trimesh.creation.capsule(0.2, 0.05, count=(256, 256))
        moments = np.diag(mesh.moment_inertia)
    for link, collision, density in (
        ('<inertial auto="true"/>', "", 1000),
        ('<inertial auto="true"><density>300</density></inertial>', "", 300),
        ('<inertial auto="true"><density>300</density></inertial>', "<density>40</density>", 40),
        (f'<inertial auto="true"><mass>{70 * volume}</mass></inertial>', "", 70),
    ):
        asset = listed(tmp_path, "it.sdf", sdf(shape, link, collision=collision))
        assert asset.mass == pytest.approx(density * volume, rel=1e-5)
        assert np.diag(asset.inertia) == pytest.approx(density * np.array(moments), rel=2e-3)


def test_automatic_inertia_of_an_open_mesh_is_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2, 0.1)
    trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.03]).export(tmp_path / "it.stl")
    with pytest.raises(InvalidInputError, match=r"it.stl: collision 1 of link 'l'.*not closed; give a mass"):
        listed(tmp_path, "it.sdf", sdf("<mesh><uri>it.stl</uri></mesh>", '<inertial auto="true"/>'))


def test_quaternions_turn_as_angles_do(tmp_path: Path) -> None:
    angles = (0.3, -0.4, 1.2)
    quaternion = " ".join(map(str, Rotation.from_euler("xyz", angles).as_quat() * 2))
    rpy = " ".join(map(str, angles))
    text = urdf('<box size="0.2 0.1 0.04"/>').replace("<collision>", "<collision><origin {}/>")
    by_angles = listed(tmp_path, "it.urdf", text.format(f'rpy="{rpy}"'))
    by_quaternion = listed(tmp_path, "it.urdf", text.format(f'quat_xyzw="{quaternion}"'))
    assert by_quaternion.bounds == pytest.approx(by_angles.bounds, abs=1e-12)
    pose = f'<pose rotation_format="quat_xyzw">0 0 0 {quaternion}</pose>'
    model = sdf("<box><size>0.2 0.1 0.04</size></box>", collision=pose)
    assert listed(tmp_path, "it.sdf", model).bounds == pytest.approx(by_angles.bounds, abs=1e-12)
    with pytest.raises(CorruptFileError, match="has both rpy and quat_xyzw; keep one"):
        listed(tmp_path, "it.urdf", text.format(f'rpy="{rpy}" quat_xyzw="{quaternion}"'))
    with pytest.raises(CorruptFileError, match="the quaternion of collision 1 of link 'l' is 0"):
        listed(tmp_path, "it.urdf", text.format('quat_xyzw="0 0 0 0"'))


WEIGHT = (
    '<inertial><mass value="2"/><inertia ixx="0.01" iyy="0.01" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>'
    '<collision><geometry><box size="0.4 0.2 0.02"/></geometry></collision>'
)


@pytest.mark.slow
@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize(
    ("parent", "kind", "static"),
    [("world", "fixed", True), ("base", "fixed", False), ("world", "revolute", True), ("world", "floating", False)],
)
def test_what_hangs_on_the_world_is_welded(
    tmp_path: Path, declared: bool, parent: str, kind: str, static: bool
) -> None:
    """Drake counts 6 more velocities for a free body than for one that a joint holds."""
    first = f'<link name="{parent}"/>' if declared or parent != "world" else ""
    text = (
        f'<robot name="r">{first}<link name="board">{WEIGHT}</link>'
        f'<joint name="j" type="{kind}"><parent link="{parent}"/>'
        '<child link="board"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>'
    )
    asset = listed(tmp_path, "it.urdf", text)
    assert asset.static is static
    assert ("a joint holds it at `world`" in said(tmp_path)) is static
    assert not listed(tmp_path, "it.urdf", text, ", welded: false").static
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(tmp_path / "it.urdf"))
    plant.Finalize()
    assert plant.num_velocities() == (1 if kind == "revolute" else 0 if static else 6)


def test_an_sdf_joint_to_the_world_welds_and_one_between_links_does_not(tmp_path: Path) -> None:
    shape = "<box><size>0.2 0.1 0.04</size></box>"
    joint = '<joint name="j" type="fixed"><parent>{}</parent><child>l</child></joint>'
    assert listed(tmp_path, "it.sdf", sdf(shape, rest=joint.format("world"))).static
    other = '<link name="m"/>' + joint.format("m")
    assert not listed(tmp_path, "it.sdf", sdf(shape, rest=other)).static
    model = (
        f'<model name="r"><link name="l"><collision name="c"><geometry>{shape}</geometry></collision></link></model>'
    )
    world = joint.format("world").replace(">l<", ">r::l<")
    assert listed(tmp_path, "it.sdf", f'<sdf version="1.11"><world name="w">{model}{world}</world></sdf>').static


def test_a_center_of_mass_stays_where_only_the_inertia_is_missing(tmp_path: Path) -> None:
    box = '<box size="0.2 0.1 0.04"/>'
    given = '<inertial><origin xyz="0.03 0.01 -0.005"/><mass value="0.6"/></inertial>'
    asset = listed(tmp_path, "it.urdf", urdf(box, given))
    assert asset.mass == pytest.approx(0.6)
    assert asset.center_of_mass == pytest.approx([0.03, 0.01, 0.015])
    assert np.diag(asset.inertia) == pytest.approx(box_moments(BOX, 0.6 / np.prod(BOX)))
    assert "inertia computed from the shape: the file gives none" in said(tmp_path)
    given = "<inertial><pose>0.03 0.01 -0.005 0 0 0</pose><mass>0.6</mass></inertial>"
    same = listed(tmp_path, "it.sdf", sdf("<box><size>0.2 0.1 0.04</size></box>", given))
    assert same.center_of_mass == pytest.approx(asset.center_of_mass)
    assert same.inertia == pytest.approx(asset.inertia)


def test_visuals_of_size_zero_are_left_out_and_named(tmp_path: Path) -> None:
    nothing = '<visual><geometry><sphere radius="0.0"/></geometry></visual>'
    assert sizes(listed(tmp_path, "it.urdf", urdf('<box size="0.2 0.1 0.04"/>', nothing))) == list(BOX)
    assert "visual 1 of link 'l' has a size of 0, which is left out" in said(tmp_path)
    nothing = '<visual name="v"><geometry><sphere><radius>0</radius></sphere></geometry></visual>'
    assert sizes(listed(tmp_path, "it.sdf", sdf("<box><size>0.2 0.1 0.04</size></box>", nothing))) == list(BOX)


def test_xml_that_other_readers_take(tmp_path: Path) -> None:
    """A comment before the declaration, prefixes without a declaration in elements and attributes."""
    text = urdf('<box size="0.2 0.1 0.04"/>', '<drake:thing drake:key="1"/>')
    asset = listed(tmp_path, "it.urdf", f'\n<!-- made by hand -->\n<?xml version="1.0"?>\n{text}')
    assert sizes(asset) == list(BOX)
    assert "not read: link/drake:thing" in said(tmp_path)
    with pytest.raises(CorruptFileError, match="expand it with xacro first"):
        listed(tmp_path, "it.urdf", urdf('<box size="0.2 0.1 0.04"/>', "<xacro:arm/>"))
    with pytest.raises(CorruptFileError, match="several links called 'l'; give each its own name"):
        listed(tmp_path, "it.urdf", urdf('<box size="0.2 0.1 0.04"/>', rest='<link name="l"/>'))


@pytest.mark.parametrize("how", ["package.xml", "beside", "AMENT_PREFIX_PATH", "GZ_SIM_RESOURCE_PATH", "escaped"])
def test_packages_are_found_as_ros_and_gazebo_find_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    folder = tmp_path / "download-1" / "urdf"
    meshes = {
        "package.xml": folder.parent,
        "beside": tmp_path / "other-main",
        "AMENT_PREFIX_PATH": tmp_path / "install" / "share" / "cup",
        "GZ_SIM_RESOURCE_PATH": tmp_path / "models" / "cup",
        "escaped": tmp_path / "download-1" / "a cup",
    }[how]
    for path in (folder, meshes):
        path.mkdir(parents=True, exist_ok=True)
    block().export(meshes / "m.stl")
    if how in ("package.xml", "beside"):
        (meshes / "package.xml").write_text('<package format="3"><name>cup</name></package>')
    elif how != "escaped":
        monkeypatch.setenv(how, str(tmp_path / ("install" if how.startswith("AMENT") else "models")))
    name = {"GZ_SIM_RESOURCE_PATH": "model://cup/m.stl", "escaped": "../a%20cup/m.stl"}.get(how, "package://cup/m.stl")
    assert sizes(listed(folder, "it.urdf", urdf(f'<mesh filename="{name}"/>'))) == list(BOX)


def test_meshes_of_one_name_in_two_folders_are_two_files(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        block().export(tmp_path / folder / "body.stl")
    (tmp_path / "one" / "brick.urdf").write_text(urdf('<mesh filename="body.stl"/>'))
    assert load_library(tmp_path).names == ("brick", "body")
    assert [str(report.file.parent.name) for report in import_report(tmp_path).assets] == ["one", "two"]


# -- the schemas ----------------------------------------------------------------------------------

SCHEMAS = {
    "URDF": """robot: @name @version link joint material transmission gazebo sensor
link: @name @type inertial visual collision
joint: @name @type origin parent child axis calibration dynamics limit safety_controller mimic
axis: @xyz
limit: @lower @upper @effort @velocity
dynamics: @damping @friction
parent: @link
child: @link
origin: @xyz @rpy @quat_xyzw
inertial: origin mass inertia
mass: @value
inertia: @ixx @iyy @izz @ixy @ixz @iyz
visual: @name origin geometry material
collision: @name origin geometry verbose
geometry: box cylinder sphere capsule mesh
mesh: @filename @scale
box: @size
cylinder: @radius @length
capsule: @radius @length
sphere: @radius
material: @name color texture
color: @rgba""",
    "SDF": """sdf: @version world model actor light
world: @name audio wind include gravity magnetic_field atmosphere gui physics scene light frame joint model actor
plugin road
spherical_coordinates state population
model: @name @namespace @canonical_link @placement_frame static self_collide allow_auto_disable enable_wind frame
pose link
joint plugin gripper
link: @name gravity enable_wind self_collide kinematic must_be_base_link velocity_decay pose inertial collision
visual sensor
projector audio_sink audio_source battery light particle_emitter
joint: @name @type parent child gearbox_ratio gearbox_reference_body thread_pitch screw_thread_pitch axis axis2
physics pose
sensor
axis: initial_position xyz use_parent_model_frame mimic dynamics limit
xyz: @expressed_in
limit: lower upper effort velocity stiffness dissipation
dynamics: damping friction spring_reference spring_stiffness
frame: @name @attached_to pose
pose: @relative_to @rotation_format @degrees
inertial: @auto mass density auto_inertia_params pose inertia fluid_added_mass
inertia: ixx iyy izz ixy ixz iyz
visual: @name cast_shadows laser_retro transparency visibility_flags meta pose material geometry plugin
collision: @name laser_retro max_contacts density material_density auto_inertia_params pose geometry surface
geometry: empty box capsule cylinder ellipsoid mesh plane sphere
mesh: @optimization convex_decomposition uri submesh scale
submesh: name center
box: size
cylinder: radius length
capsule: radius length
sphere: radius
ellipsoid: radii
plane: normal size
material: script shader lighting render_order ambient diffuse specular shininess emissive double_sided pbr""",
}
"""Elements and attributes of urdf.xsd of urdfdom and of the descriptions of SDFormat 1.12, but for those inside
elements that are left out as a whole; <heightmap>, <image>, <polyline> and <cone> are refused."""


READ = {kind: {tag: names.split() for tag, names in FORMATS[kind]["read"].items()} for kind in ("URDF", "SDF")}
LEFT_OUT = {kind: set(" ".join(FORMATS[kind]["left out"].values()).split()) for kind in ("URDF", "SDF")}


def schema(kind: str) -> list[tuple[str, str]]:
    found, tag = [], ""
    for word in SCHEMAS[kind].split():
        if word.endswith(":"):
            tag = word[:-1]
        else:
            found.append((tag, word))
    return found


FULL = {
    "URDF": """<robot name="r"><material name="red"><color rgba="1 0 0 1"/></material><link name="a"><inertial>
<origin xyz="0.01 0.02 0" rpy="0.1 0.2 0.3"/><mass value="2"/><inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0.001"
ixz="0.002" iyz="0.003"/></inertial><visual><origin xyz="0 0 0.1"/><geometry><sphere
radius="0.1"/></geometry><material
name="red"/></visual><collision><geometry><box size="0.2 0.1
0.04"/></geometry></collision><collision><geometry><cylinder
radius="0.1" length="0.3"/></geometry></collision><collision><geometry><capsule radius="0.1" length="0.3"/></geometry>
</collision><collision><origin quat_xyzw="0 0 1 1"/><geometry><mesh filename="m.stl" scale="1 2
3"/></geometry></collision>
</link><link name="b"/><joint name="j" type="fixed"><parent link="a"/><child link="b"/><origin xyz="1 0 0"/></joint>
<link name="c"/><joint name="k" type="revolute"><parent link="a"/><child link="c"/><axis xyz="0 0 1"/><limit lower="-1"
upper="1"/><dynamics damping="1" friction="2"/></joint><link name="d"/><joint name="l" type="continuous"><parent
link="a"/><child link="d"/><mimic joint="k"/></joint></robot>""",
    "SDF": """<sdf version="1.11"><world name="w"><model name="r"><static>true</static><frame name="f"
attached_to="a"><pose>1 0 0
0 0 0</pose></frame><link name="a"><pose relative_to="" degrees="true">0 0 1 90 0 0</pose><inertial
auto="false"><pose>0.01
0.02 0 0.1 0.2
0.3</pose><mass>2</mass><density>300</density><inertia><ixx>0.01</ixx><iyy>0.02</iyy><izz>0.03</izz><ixy>0.001</ixy><ixz>0.002
</ixz><iyz>0.003</iyz></inertia></inertial><visual name="v"><geometry><sphere><radius>0.1</radius></sphere></geometry>
<material><diffuse>1 0 0 1</diffuse></material></visual><collision name="c"><pose relative_to="f"
rotation_format="quat_xyzw">0 0 0 0 0 1 1</pose><geometry><box><size>0.2 0.1 0.04</size></box></geometry></collision>
<collision name="d"><geometry><cylinder><radius>0.1</radius><length>0.3</length></cylinder></geometry></collision>
<collision name="e"><geometry><capsule><radius>0.1</radius><length>0.3</length></capsule></geometry></collision>
<collision name="f"><geometry><ellipsoid><radii>0.1 0.2 0.3</radii></ellipsoid></geometry></collision><collision
name="g">
<geometry><mesh optimization="convex_hull"><uri>m.stl</uri><scale>1 2
3</scale><submesh><name>x</name><center>true</center>
</submesh></mesh></geometry></collision></link><link name="b"><inertial
auto="true"><density>7</density></inertial><collision
name="c"><density>9</density><geometry><sphere><radius>0.1</radius></sphere></geometry></collision><collision
name="d">
<material_density>8</material_density><geometry><sphere><radius>0.2</radius></sphere></geometry></collision><collision
name="e"><geometry><sphere><radius>0.3</radius></sphere></geometry></collision></link><joint name="j" type="fixed">
<pose relative_to="f">0 0 2 0 0 0</pose><parent>a</parent><child>b</child></joint><frame name="h"
attached_to="j"/><link
name="c"><pose relative_to="h"/><visual
name="p"><geometry><plane/></geometry></visual></link><joint name="k" type="revolute"><pose>0 0 0 0.1 0
0</pose><parent>a</parent><child>c</child><axis><xyz expressed_in="f">0 0 1</xyz><limit><lower>-1</lower>
<upper>1</upper></limit><dynamics><damping>1</damping><friction>2</friction></dynamics></axis></joint><link
name="d"/><joint name="l" type="revolute">
<pose>0 0 0 0.1 0 0</pose><parent>a</parent><child>d</child><axis><use_parent_model_frame>true</use_parent_model_frame>
</axis></joint><link name="e"/><joint name="m" type="revolute"><parent>a</parent><child>e</child><axis>
<mimic joint="k"/></axis></joint></model></world></sdf>""",
}
"""A file with all that is read."""


def read(folder: Path, kind: str, root: ElementTree.Element) -> Model:
    block().export(folder / "m.stl")
    path = folder / f"it.{kind.lower()}"
    path.write_bytes(ElementTree.tostring(root))
    return read_urdf(path) if kind == "URDF" else read_sdf(path)


def unread(model: Model) -> str:
    return next((note for note in model.notes if note.startswith("not read: ")), "")


@pytest.mark.parametrize("kind", ["URDF", "SDF"])
def test_each_entry_of_the_schemas_is_read_or_left_out_on_purpose_or_named(tmp_path: Path, kind: str) -> None:
    left_out = LEFT_OUT[kind]
    for tag, name in schema(kind):
        known = name in READ[kind].get(tag, []) or f"{name}*" in READ[kind].get(tag, [])
        if known:
            continue
        root = ElementTree.fromstring(FULL[kind])
        parent = next(element for element in root.iter() if element.tag == tag)
        if name.startswith("@"):
            parent.set(name[1:], "1")
        else:
            ElementTree.SubElement(parent, name)
        note = unread(read(tmp_path, kind, root))
        assert (f"{tag}/{name}" in note) is (f"{tag}/{name}" not in left_out), (tag, name, note)
    tables = {f"{tag}/{name.rstrip('*')}" for tag, names in READ[kind].items() for name in names} | left_out
    strange = tables - {f"{tag}/{name}" for tag, name in schema(kind)} - {"mesh/drake:declare_convex"}
    assert not strange  # nothing in the tables that the schemas do not know


def summary(model: Model) -> tuple[Any, ...]:
    shapes = [
        (s.kind, s.size, s.pose.tobytes(), s.color, s.is_convex, s.part) for s in model.visuals + model.collisions
    ]
    inertials = [(i.mass, i.center_of_mass.tobytes(), i.inertia.tobytes()) for _, i in model.inertials]
    joints = [(*vars(joint).values(), joint.pose.tobytes(), joint.axis.tobytes()) for joint in model.joints]
    plain = [tuple(value for value in row if not isinstance(value, np.ndarray)) for row in joints]
    return shapes, inertials, model.static, model.notes, plain, model.faults


@pytest.mark.parametrize("kind", ["URDF", "SDF"])
def test_each_value_that_is_said_to_be_read_matters(tmp_path: Path, kind: str) -> None:
    """Another value, or nonsense, gives another model or an error; so does a second of what may be there once."""
    covered = set()
    full = FULL[kind], FULL[kind].replace("<static>true</static>", "")  # the joints of a static model are frozen
    for text, index in [(t, i) for t in full for i in range(len(list(ElementTree.fromstring(t).iter())))]:
        expected = summary(read(tmp_path, kind, ElementTree.fromstring(text)))
        assert not unread(read(tmp_path, kind, ElementTree.fromstring(text)))
        for key in (None, *list(ElementTree.fromstring(text).iter())[index].attrib):
            root = ElementTree.fromstring(text)
            element = list(root.iter())[index]
            name = f"@{key}" if key else ""
            if key is None and (len(element) or not (element.text or "").strip()):
                continue
            parents = {child: parent for parent in root.iter() for child in parent}
            place = f"{element.tag}/{name}" if key else f"{parents[element].tag}/{element.tag}"
            if place in LEFT_OUT[kind]:
                continue
            if key:
                element.set(key, "§")
            else:
                element.text = "§"
            try:
                changed = summary(read(tmp_path, kind, root)) != expected
            except (CorruptFileError, InvalidInputError):
                changed = True
            if changed:
                covered.add(place)
    needed = {
        f"{tag}/{name.rstrip('*')}"
        for tag, names in READ[kind].items()
        for name in names
        if name.startswith("@") or (kind == "SDF" and name.rstrip("*") not in READ[kind])
    }
    names = {
        "model/@name",
        "frame/@name",
        "joint/@name",
        "plane/normal",
        "geometry/plane",
        "geometry/empty",
        "mesh/drake:declare_convex",
    }
    assert needed - covered - names == set()


def test_a_second_element_is_named(tmp_path: Path) -> None:
    listed(tmp_path, "it.urdf", urdf('<box size="0.2 0.1 0.04"/><sphere radius="9"/>', "<inertial/><inertial/>"))
    for name in ("second link/inertial", "second geometry"):
        assert name in said(tmp_path)
