"""A folder of mesh files and its YAML as an asset library."""

from __future__ import annotations

import logging
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from scene_envs.assets import Asset, get_library, import_report, load_library
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError, UnknownNameError
from scene_envs.scene_types import get_scene_type, register_scene_type

SIZE = (0.1, 0.06, 0.04)


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(folder))
    return folder


def brick(offset: tuple[float, float, float] = (0.3, -0.2, 0.5)) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(SIZE)
    mesh.apply_translation(offset)
    return mesh


def write_yaml(folder: Path, text: str) -> None:
    (folder / "library.yaml").write_text(textwrap.dedent(text))


def only(folder: Path) -> Asset:
    (asset,) = load_library(folder)
    return asset


# -- formats --------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "off", "glb", "dae"])
def test_every_format_gives_the_same_brick(tmp_path: Path, suffix: str) -> None:
    mesh = brick()
    if suffix == "dae":
        pytest.importorskip("collada")
    if suffix in ("glb", "dae"):  # y up in the file
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0)))
    mesh.export(tmp_path / f"red_brick.{suffix}")
    write_yaml(tmp_path, f"- {{file: red_brick.{suffix}, density: 2000}}")
    asset = only(tmp_path)
    assert asset.name == "red_brick"
    assert (asset.display_name, asset.plural) == ("red brick", "red bricks")
    low, high = asset.bounds
    assert low == pytest.approx([-0.05, -0.03, 0.0], abs=1e-6)
    assert high == pytest.approx([0.05, 0.03, 0.04], abs=1e-6)
    assert asset.visual.bounds == pytest.approx(asset.bounds, abs=1e-6)
    x, y, z = SIZE
    mass = 2000 * x * y * z
    assert asset.mass == pytest.approx(mass, rel=1e-5)
    assert asset.center_of_mass == pytest.approx([0, 0, 0.02], abs=1e-6)
    assert np.diag(asset.inertia) == pytest.approx(
        mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y]), rel=1e-4
    )
    assert len(asset.fine) == len(asset.coarse) == 1


def test_a_mesh_in_millimetres_that_lies_on_its_side(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((40.0, 100.0, 60.0))  # up is x
    mesh.export(tmp_path / "brick.stl")
    write_yaml(tmp_path, "- {file: brick.stl, scale: 0.001, up: x, mass: 0.5}")
    asset = only(tmp_path)
    assert (asset.bounds[1] - asset.bounds[0]) == pytest.approx([0.06, 0.1, 0.04], abs=1e-7)
    assert asset.mass == 0.5


@pytest.mark.parametrize(
    ("up", "tip"), [("x", (1, 0, 0)), ("-x", (-1, 0, 0)), ("y", (0, 1, 0)), ("-y", (0, -1, 0)), ("-z", (0, 0, -1))]
)
def test_the_axis_named_up_points_up(tmp_path: Path, up: str, tip: tuple[int, int, int]) -> None:
    """A thin spike stands on a base; the centre of mass stays in the lower half only the right way up."""
    cone = trimesh.creation.cone(0.05, 0.2)  # base at z = 0, tip at z = 0.2
    cone.apply_transform(trimesh.geometry.align_vectors((0, 0, 1), tip))
    cone.export(tmp_path / "spike.stl")
    write_yaml(tmp_path, f"- {{file: spike.stl, up: '{up}'}}")
    asset = only(tmp_path)
    assert asset.bounds[1, 2] == pytest.approx(0.2, abs=1e-6)
    assert asset.center_of_mass[2] == pytest.approx(0.05, rel=0.01)  # a quarter of the height of a cone


def test_the_frame_of_the_file_is_kept_on_request_and_always_told(tmp_path: Path) -> None:
    brick().export(tmp_path / "brick.stl")
    write_yaml(tmp_path, "- {file: brick.stl, name: a}\n- {file: brick.stl, name: b, base: origin}")
    library, report = load_library(tmp_path), import_report(tmp_path)
    assert library["b"].bounds.mean(axis=0) == pytest.approx([0.3, -0.2, 0.5], abs=1e-6)
    assert report["a"].origin == pytest.approx((-0.3, 0.2, -0.48), abs=1e-6)
    assert report["b"].origin == (0.0, 0.0, 0.0)


def test_colors_of_the_file_reach_the_picture(tmp_path: Path) -> None:
    mesh = brick()
    mesh.visual.vertex_colors = np.tile(np.array([200, 30, 40, 255], dtype=np.uint8), (len(mesh.vertices), 1))
    mesh.export(tmp_path / "painted.ply")
    brick().export(tmp_path / "plain.stl")
    write_yaml(tmp_path, "- {file: painted.ply}\n- {file: plain.stl, color: '#0a6480'}")
    library = load_library(tmp_path)
    assert np.unique(library["painted"].visual.visual.vertex_colors[:, :3], axis=0).tolist() == [[200, 30, 40]]
    assert np.unique(library["plain"].visual.visual.vertex_colors[:, :3], axis=0).tolist() == [[10, 100, 128]]
    assert library["plain"].color == (10, 100, 128)


def test_a_texture_colors_the_triangles_that_show_it(tmp_path: Path) -> None:
    from PIL import Image

    pixels = np.zeros((8, 8, 3), dtype=np.uint8)
    pixels[:, :4], pixels[:, 4:] = (220, 20, 20), (20, 20, 220)
    Image.fromarray(pixels).save(tmp_path / "two.png")
    (tmp_path / "two.mtl").write_text("newmtl two\nKd 1 1 1\nmap_Kd two.png\n")
    corners = [(x, y, z) for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]
    lines = ["mtllib two.mtl", "usemtl two", *(f"v {x} {y} {z}" for x, y, z in corners)]
    lines += ["vt 0.2 0.5", "vt 0.8 0.5"]
    for face in trimesh.convex.convex_hull(np.array(corners)).faces:
        up = all(corners[i][2] == 0.1 for i in face)
        lines.append("f " + " ".join(f"{i + 1}/{2 if up else 1}" for i in face))
    (tmp_path / "two.obj").write_text("\n".join(lines))
    visual = load_library(tmp_path)["two"].visual
    colors = visual.visual.vertex_colors[:, :3][visual.faces[:, 0]]
    is_top = (visual.vertices[visual.faces][..., 2] > 0.099).all(axis=1)
    assert visual.area_faces[is_top].sum() == pytest.approx(0.01)
    assert np.unique(colors[is_top], axis=0).tolist() == [[20, 20, 220]]
    assert np.unique(colors[~is_top], axis=0).tolist() == [[220, 20, 20]]


# -- folders --------------------------------------------------------------------------------------


def test_without_yaml_every_readable_file_is_an_asset_and_that_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    brick().export(tmp_path / "soap.stl")
    (tmp_path / "more").mkdir()
    brick().export(tmp_path / "more" / "brick_mesh.obj")
    (tmp_path / "more" / "brick.urdf").write_text(
        '<robot name="b"><link name="l"><visual><geometry><mesh filename="brick_mesh.obj"/></geometry></visual>'
        "</link></robot>"
    )
    (tmp_path / "broken.stl").write_bytes(b"solid but not really")
    (tmp_path / "readme.txt").write_text("not an asset")
    with caplog.at_level(logging.INFO, logger="scene_envs"):
        library = load_library(tmp_path)
    assert library.names == ("brick", "soap")  # the mesh belongs to the URDF
    assert "no library.yaml" in caplog.text
    assert "broken.stl" in caplog.text
    assert "500 kg/m^3" in caplog.text
    report = import_report(tmp_path)
    assert "broken.stl" in report["broken"].error
    assert len(str(report).splitlines()) == 2 + 3
    assert len({asset.color for asset in library}) == 2


def test_assets_are_built_once_until_their_file_changes(tmp_path: Path) -> None:
    brick().export(tmp_path / "brick.stl")
    first = load_library(tmp_path)["brick"]
    assert load_library(str(tmp_path))["brick"] is first
    assert get_library(("teacup", "brick"), (tmp_path,))["brick"] is first
    trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().export(tmp_path / "brick.stl")
    assert load_library(tmp_path)["brick"].bounds[1, 2] == pytest.approx(0.2, abs=1e-6)


def test_own_assets_come_before_built_in_ones_and_unknown_names_offer_both(tmp_path: Path) -> None:
    brick().export(tmp_path / "teapot.stl")
    library = get_library(("teapot", "teacup"), (str(tmp_path),))
    assert len(library["teapot"].fine[0].vertices) == 8
    assert library["teacup"] is get_library(("teacup",))["teacup"]
    with pytest.raises(UnknownNameError, match="did you mean 'teapot'"):
        get_library(("teapott",), (str(tmp_path),))


def test_assets_of_a_registered_scene_type_are_found_by_name_alone(tmp_path: Path) -> None:
    brick().export(tmp_path / "yellow_brick.stl")
    with pytest.raises(UnknownNameError, match="give the folder in folders="):
        get_library(["yellow_brick"])
    table = get_scene_type("dimsum_table")
    changes = {"name": "a_yellow_table", "assets": ("cafe_table", "yellow_brick"), "asset_folders": (str(tmp_path),)}
    register_scene_type(replace(table, **changes))
    brick_again, cup = get_library(["yellow_brick", "teacup"])
    assert brick_again.display_name == "yellow brick"
    assert cup.name == "teacup"


def test_a_name_that_is_no_list_of_names_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"as in \['teacup'\]"):
        get_library("teacup")


def test_class_colors_differ_from_each_other_and_from_the_built_in_ones(tmp_path: Path) -> None:
    brick().export(tmp_path / "brick.stl")
    write_yaml(tmp_path, "\n".join(f"- {{file: brick.stl, name: brick_{i}}}" for i in range(10)))
    built_in = get_library(("cafe_table", "teapot", "steamer_lid"))
    colors = np.array([a.color for a in (*load_library(tmp_path), *built_in)], dtype=float)
    gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(len(colors))
    assert gaps.min() > 25


# -- what is wrong is said ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- {file: brick.stl, densty: 4}", "unknown key 'densty'; did you mean 'density'"),
        ("- {file: brick.stl, scale: 0}", "(brick.stl): scale=0 must be a positive number"),
        ("- {file: brick.stl, scale: -1e-3}", "scale=-0.001 must be a positive number"),
        ("- {file: brick.stl, scale: -1}", "scale=-1 must be a positive number"),
        ("- {file: brick.stl, mass: heavy}", "mass='heavy' must be a positive number"),
        ("- {file: brick.stl, mass: .nan}", "mass=nan must be a positive number"),
        ("- {file: brick.stl, mass: 1, density: 2}", "mass or density, not both"),
        ("- {file: brick.stl, welded: true, mass: 1}", "welded asset has no mass"),
        ("- {file: brick.stl, welded: 'yes'}", "welded must be true or false"),
        ("- {file: brick.stl, up: w}", "up='w' must be one of x, y, z"),
        ("- {file: brick.stl, decomposition: vhacd}", "decomposition='vhacd' must be one of auto, coacd, convex"),
        ("- {file: brick.stl, color: [1, 2]}", "color must be"),
        ("- {file: brick.stl, name: 3}", "name=3 must be text"),
        ("- {file: brick.stl, name: ' '}", "name='' must be text"),
        ("- {file: brick.stl, plural: ''}", "plural='' must be text"),
        ("- {file: brick.stl, scale: ''}", "scale='' must be a positive number"),
        ("- {file: brick.stl, color: ''}", "color must be"),
        ("- {file: brick.stl, welded: ''}", "welded must be true or false"),
        ("- {file: brick.stl}\n- {file: brick.stl}", "both called 'brick'"),
        ("- {file: stone.stl}", "no such file"),
        ("- {file: brick.step}", "cannot be read; known: .urdf, .sdf"),
        ("- {name: brick}", "needs a `file`"),
        ("- brick.stl", "must be a mapping"),
        ("file: brick.stl", "must be a list"),
        ("", "must be a list"),
    ],
)
def test_a_wrong_entry_names_file_value_and_remedy(tmp_path: Path, text: str, message: str) -> None:
    brick().export(tmp_path / "brick.stl")
    write_yaml(tmp_path, text)
    with pytest.raises(InvalidInputError) as caught:
        load_library(tmp_path)
    assert message in str(caught.value)
    assert "library.yaml" in str(caught.value)


def test_broken_yaml_names_the_line(tmp_path: Path) -> None:
    write_yaml(tmp_path, "- {file: brick.stl\n- {")
    with pytest.raises(CorruptFileError, match=r"library.yaml is not well-formed YAML.*line 2"):
        load_library(tmp_path)


def _file(folder: Path, name: str, content: str | bytes) -> None:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    write_yaml(folder, f"- file: {name}")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", b"", "is empty"),
        ("a.obj", "# nothing\n", "a.obj"),
        ("a.stl", b"\x00" * 200, "a.stl"),
        ("a.glb", b"glTF but no more", "cannot be read as a GLB mesh"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv nan 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n", "coordinates must be finite"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "a.obj"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "spans no volume"),
        ("a.stl", "version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    ],
)
def test_an_unreadable_mesh_names_the_file_and_the_reason(
    tmp_path: Path, name: str, content: str | bytes, message: str
) -> None:
    _file(tmp_path, name, content)
    with pytest.raises((CorruptFileError, InvalidInputError)) as caught:
        load_library(tmp_path)
    assert message in str(caught.value)
    assert name in str(caught.value)


def test_corners_with_two_coordinates_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0\nv 1 0\nv 1 1\nf 1 2 3\n")
    write_yaml(tmp_path, "- {file: flat.obj}")
    with pytest.raises(CorruptFileError, match=r"flat.obj.*\(3, 2\)"):
        load_library(tmp_path)


def test_a_folder_that_is_missing_or_empty(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="there is no folder"):
        load_library(tmp_path / "nowhere")
    with pytest.raises(InvalidInputError, match="holds no"):
        load_library(tmp_path)
    (tmp_path / "a.stl").write_bytes(b"")
    with pytest.raises(SceneEnvsError, match="no file that can be read"):
        load_library(tmp_path)


def test_a_size_that_is_no_object_of_this_world_asks_for_a_scale(tmp_path: Path) -> None:
    trimesh.creation.box((100.0, 60.0, 40.0)).export(tmp_path / "brick.stl")
    assert "set `scale`" in str(import_report(tmp_path)["brick"])


def test_thin_parts_are_said(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.001)).export(tmp_path / "sheet.stl")
    assert "thinner than 3 mm (the thinnest 1 mm)" in str(import_report(tmp_path)["sheet"])
