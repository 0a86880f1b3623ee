"""Assets that others made: the data package of PyBullet, in scenes of a type with a user's folder."""

from __future__ import annotations

import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from scene_envs.assets import Asset, AssetLibrary, import_report, load_library
from scene_envs.physics import PhysicsPool, feasibility, penetration
from scene_envs.render import observe
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, FixedObject, SceneType, register_scene_type

pytestmark = pytest.mark.slow

bullet = pytest.importorskip("pybullet")
pybullet_data = pytest.importorskip("pybullet_data")
DATA = Path(pybullet_data.getDataPath())
FILES = {
    "jenga": "jenga/jenga.urdf",
    "kiva_shelf": "kiva_shelf/model.sdf",
    "lego": "lego/lego.urdf",
    "mug": "objects/mug.urdf",
    "tray": "tray/tray.urdf",
    "traybox": "tray/traybox.urdf",
    **{f"blob_{i}": f"random_urdfs/{i:03d}/{i:03d}.urdf" for i in (0, 1, 42, 137)},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("library")
    entries = [f"- {{file: {DATA / file}, name: {name}, decomposition: convex}}" for name, file in FILES.items()]
    entries = [e.replace(", decomposition: convex", "") if "mug" not in e else e for e in entries]
    (folder / "library.yaml").write_text("\n".join(entries))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SCENE_ENVS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield folder


@pytest.fixture(scope="module")
def library(folder: Path) -> AssetLibrary:
    return load_library(folder)


@pytest.fixture(scope="module")
def scene_type(folder: Path) -> SceneType:
    return register_scene_type(
        SceneType(
            name="user_library_test",
            assets=("cafe_table", *FILES),
            slots=24,
            workspace=((-0.6, -0.6, -0.02), (0.6, 0.6, 1.0)),
            welded=("cafe_table",),
            fixed=(FixedObject("cafe_table"),),
            camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
            asset_folders=(str(folder),),
        )
    )


def in_bullet(name: str) -> tuple[float, ...]:
    """Mass and inertia moments (kg m^2, ascending) as PyBullet reads and computes them, with its default flags."""
    client = bullet.connect(bullet.DIRECT)
    path = str(DATA / FILES[name])
    if path.endswith(".sdf"):
        (body,) = bullet.loadSDF(path, physicsClientId=client)
    else:
        body = bullet.loadURDF(path, physicsClientId=client)
    mass, _, moments, *_ = bullet.getDynamicsInfo(body, -1, physicsClientId=client)
    bullet.disconnect(client)
    return (mass, *sorted(moments))


@pytest.mark.parametrize("name", FILES)
def test_masses_are_those_that_pybullet_reads(library: AssetLibrary, name: str) -> None:
    asset = library[name]
    assert asset.mass == pytest.approx(in_bullet(name)[0])
    assert asset.static == (name in ("kiva_shelf", "tray", "traybox"))


@pytest.mark.parametrize(("name", "difference"), [("jenga", 1e-3), ("lego", 0.15)])
def test_inertia_of_boxes_is_what_pybullet_computes(library: AssetLibrary, name: str, difference: float) -> None:
    """Both files give 1 kg m^2 about every axis, which neither believes.

    PyBullet takes a turned box, the lego's, for its bounding box with margins of 1 mm.
    """
    assert np.linalg.eigvalsh(library[name].inertia) == pytest.approx(in_bullet(name)[1:], rel=difference)


@pytest.mark.parametrize("name", [name for name in FILES if name.startswith("blob")])
def test_random_objects_keep_their_pieces_and_get_the_inertia_of_their_shape(
    library: AssetLibrary, folder: Path, name: str
) -> None:
    asset = library[name]
    mesh = trimesh.load_mesh(DATA / FILES[name].replace(".urdf", ".obj"), process=False)
    mesh = trimesh.Trimesh(0.015 * mesh.vertices, mesh.faces)
    pieces = mesh.split()
    assert len(asset.fine) == len(pieces) > 1
    hulls = [piece.convex_hull for piece in pieces]
    inertia = np.zeros((3, 3))
    total = sum(hull.volume for hull in hulls)
    center = sum(hull.volume * hull.center_mass for hull in hulls) / total
    for hull in hulls:
        hull.density = asset.mass / total
        arm = hull.center_mass - center
        inertia += hull.moment_inertia + hull.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    report = import_report(folder)[name]
    assert asset.center_of_mass - report.origin == pytest.approx(center, abs=2e-4)
    assert asset.inertia == pytest.approx(inertia, abs=0.02 * inertia.max())
    assert "is not positive" in report.warnings[0]


def test_sizes_agree_with_pybullet(library: AssetLibrary) -> None:
    """PyBullet's boxes are larger by its margins; the tray's slanted walls keep their true size here."""
    client = bullet.connect(bullet.DIRECT)
    for name in ("jenga", "lego", "mug", "tray", "traybox", "blob_0"):
        body = bullet.loadURDF(str(DATA / FILES[name]), physicsClientId=client)
        low, high = np.array(bullet.getAABB(body, physicsClientId=client))
        size = library[name].bounds[1] - library[name].bounds[0]
        assert (high - low) == pytest.approx(size, abs=0.05)
        assert ((high - low) >= size - 1e-3).all()
    bullet.disconnect(client)


def test_the_shelf_is_open_and_the_tray_hollow(library: AssetLibrary) -> None:
    def inside(asset: Asset, point: tuple[float, float, float]) -> bool:
        hulls = [trimesh.convex.convex_hull(part.vertices) for part in asset.fine]
        return any(
            ((hull.triangles_center - np.array(point)) * hull.face_normals).sum(axis=1).min() > 0 for hull in hulls
        )

    shelf, tray = library["kiva_shelf"], library["traybox"]
    assert len(shelf.fine) == 20  # 21 boxes, one of them twice
    assert shelf.bounds[1, 2] == pytest.approx(2.32, abs=0.01)
    assert not inside(shelf, (0.3, 0.2, 0.6))
    assert inside(shelf, (0.3, 0.2, 0.80))  # a board
    assert not inside(tray, (0.0, 0.0, 0.08))
    assert inside(tray, (0.0, 0.0, 0.015))


def scene(scene_type: SceneType, objects: list[tuple[str, tuple[float, float, float], float]]) -> SceneBatch:
    """The table and upright objects: name, translation (m), yaw (rad)."""
    batch = SceneBatch.empty(scene_type, 1)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    for slot, (name, place, yaw) in enumerate(objects, start=1):
        c, s = float(np.cos(yaw)), float(np.sin(yaw))
        translations[0, slot] = torch.tensor(place)
        rotations[0, slot] = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        categories[0, slot] = scene_type.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def laid(scene_type: SceneType) -> SceneBatch:
    """A tower of jenga blocks, three a layer, two legos on each other, a mug and a cup-less tray."""
    objects: list[tuple[str, tuple[float, float, float], float]] = []
    for layer in range(3):
        yaw = layer * np.pi / 2
        for shift in (-0.05, 0.0, 0.05):
            place = (-shift * np.sin(yaw), shift * np.cos(yaw), 0.03 * layer)
            objects.append(("jenga", (float(place[0]), float(place[1]), place[2]), float(yaw)))
    objects += [("lego", (0.2, 0.0, 0.0), 0.3), ("lego", (0.2, 0.0, 0.023), 0.3)]
    objects += [
        ("mug", (0.0, 0.25, 0.0), 1.0),
        ("traybox", (-0.25, -0.4, 0.0), 0.0),
        ("jenga", (-0.25, -0.4, 0.02437), 0.4),
    ]
    return scene(scene_type, objects)


def test_imported_objects_stand_still_on_a_table(scene_type: SceneType) -> None:
    batch = laid(scene_type)
    result = feasibility(batch, duration=0.5)
    free = batch.is_free & (batch.categories != scene_type.assets.index("traybox"))
    assert int(free.sum()) == 13
    assert bool(result.feasible[free].all())
    assert float(result.displacement[free].max()) < 1e-3


def test_overlap_is_that_of_the_boxes(scene_type: SceneType) -> None:
    batch = scene(scene_type, [("jenga", (0.0, 0.0, 0.0), 0.0), ("lego", (0.0, 0.0, 0.027), 0.0)])
    (pairs,) = penetration(batch).pairs
    (pair,) = [pair for pair in pairs if pair.depth > 1e-6]
    assert pair.depth == pytest.approx(0.003, abs=1e-6)


def test_workers_agree_with_this_process(scene_type: SceneType) -> None:
    batch = laid(scene_type)
    with PhysicsPool(workers=1) as pool:
        assert torch.equal(feasibility(batch, pool=pool).displacement, feasibility(batch).displacement)


def test_a_scene_type_travels_to_other_processes_with_its_folder(scene_type: SceneType) -> None:
    """What is pickled is the folder, not the meshes; another process builds the same assets."""
    code = (
        "import pickle, sys; scene_type = pickle.load(sys.stdin.buffer); library = scene_type.library; "
        "print(library['jenga'].mass, library['lego'].color)"
    )
    few = dataclasses.replace(scene_type, name="few", assets=("cafe_table", "jenga", "lego"))
    plain = pickle.dumps(few)
    assert len(plain) < 2_000
    answer = subprocess.run([sys.executable, "-c", code], input=plain, capture_output=True, check=True)
    library = few.library
    assert answer.stdout.decode().split("\n")[-2] == f"{library['jenga'].mass} {library['lego'].color}"


def test_pictures_show_imported_objects_in_their_colors(scene_type: SceneType) -> None:
    batch = scene(scene_type, [("mug", (0.0, 0.25, 0.0), 1.0), ("jenga", (0.0, 0.0, 0.0), 0.0)])
    image = observe(batch, modes=["semantic"])[0]["semantic"][0]
    found = {tuple(color) for color in np.unique(image.reshape(-1, 3), axis=0).tolist()}
    assert found == {(255, 255, 255), *(scene_type.library[name].color for name in ("cafe_table", "mug", "jenga"))}
    area = (image == scene_type.library["jenga"].color).all(axis=-1).sum()
    pixel = 2 * (1.7 - 0.03) * np.tan(np.radians(22.5)) / 480  # m at the top of the block
    assert area * pixel**2 == pytest.approx(0.15 * 0.05, rel=0.08)


def test_scenes_of_a_users_assets_round_trip_through_a_file(scene_type: SceneType, tmp_path: Path) -> None:
    batch = laid(scene_type)
    assert torch.equal(SceneBatch.load(batch.save(tmp_path / "scenes.safetensors")).tensor, batch.tensor)
    assert batch.names()[0][:2] == ["cafe_table", "jenga"]
