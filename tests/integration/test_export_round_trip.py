"""Exports in simulators and viewers: poses, masses, overlaps, and the rest of a laid table."""

from __future__ import annotations

import functools
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from tests.helpers.export_scenes import deep_pairs, moved, pose_error, transform

POSE = 1e-9
STILL = (2e-4, 5e-3)
"""How far (m, rad) an object of the laid table may move in a simulator in half a second."""
SCENES = pytest.mark.parametrize("index", range(4))
JUDGED = pytest.mark.parametrize("index", [0, 1, 2])


def path_of(folder: Path, index: int, name: str) -> Path:
    return folder / f"scene_{index:03d}" / name


# -- MuJoCo ------------------------------------------------------------------------------------------


def mujoco_scene(folder, index):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path_of(folder, index, "scene.xml")))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco, model, data


def mujoco_poses(model, data):
    return {model.body(i).name: transform(data.xpos[i], data.xmat[i].reshape(3, 3)) for i in range(1, model.nbody)}


@SCENES
def test_mujoco_has_the_same_poses_and_masses(folder, scenes, index):
    _, model, data = mujoco_scene(folder, index)
    assert pose_error(scenes[index], mujoco_poses(model, data)) < POSE
    for thing in scenes[index].objects:
        if thing.welded:
            assert model.body(thing.name).weldid == 0
            continue
        body = model.body(thing.name).id
        axes = Rotation.from_quat(model.body_iquat[body], scalar_first=True).as_matrix()
        np.testing.assert_allclose(model.body_mass[body], thing.asset.mass, rtol=1e-12)
        np.testing.assert_allclose(model.body_ipos[body], thing.asset.center_of_mass, atol=1e-12)
        np.testing.assert_allclose((axes * model.body_inertia[body]) @ axes.T, thing.asset.inertia, atol=1e-10)


@JUDGED
def test_mujoco_finds_the_same_overlaps(folder, batch, index):
    _, model, data = mujoco_scene(folder, index)
    found = {
        frozenset(model.body(model.geom_bodyid[geom]).name for geom in contact.geom)
        for contact in data.contact
        if contact.dist < -1e-3
    }
    assert found == deep_pairs(batch, index)


def test_mujoco_leaves_a_laid_table_still(folder, scenes):
    mujoco, model, data = mujoco_scene(folder, 0)
    while data.time < 0.5:
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    assert (moved(scenes[0], mujoco_poses(model, data)) < STILL).all()


# -- Drake -------------------------------------------------------------------------------------------


def drake_scene(folder, index, name):
    """Plant, scene graph and diagram, shared by the tests, and a context of one's own."""
    pytest.importorskip("pydrake")
    *built, diagram = drake_diagram(folder, index, name)
    return *built, diagram, diagram.CreateDefaultContext()


@functools.cache
def drake_diagram(folder, index, name):
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, graph = AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(folder / "package.xml"))
    parser.AddModels(str(path_of(folder, index, name)))
    plant.Finalize()
    return plant, graph, builder.Build()


def drake_poses(plant, context, scene):
    context = plant.GetMyContextFromRoot(context)
    poses = {}
    for thing in scene.objects:
        body = plant.GetBodyByName(thing.asset.name, plant.GetModelInstanceByName(thing.name))
        poses[thing.name] = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
    return poses


DRAKE = pytest.mark.parametrize("name", ["scene.dmd.yaml", "world.sdf"])


@pytest.mark.slow
@DRAKE
@SCENES
def test_drake_has_the_same_poses_and_masses(folder, scenes, index, name):
    plant, _, _, context = drake_scene(folder, index, name)
    assert pose_error(scenes[index], drake_poses(plant, context, scenes[index])) < POSE
    for thing in scenes[index].objects:
        body = plant.GetBodyByName(thing.asset.name, plant.GetModelInstanceByName(thing.name))
        assert plant.IsAnchored(body) == thing.welded
        if thing.welded:
            continue
        inertia = body.default_spatial_inertia()
        center = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
        np.testing.assert_allclose(inertia.get_mass(), thing.asset.mass, rtol=1e-12)
        np.testing.assert_allclose(inertia.get_com(), thing.asset.center_of_mass, atol=1e-12)
        np.testing.assert_allclose(center.CopyToFullMatrix3(), thing.asset.inertia, atol=1e-12)


@pytest.mark.slow
@DRAKE
@JUDGED
def test_drake_finds_the_same_overlaps(folder, batch, index, name):
    plant, graph, _, context = drake_scene(folder, index, name)
    query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(context))
    inspector = query.inspector()

    def model(geometry):
        body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        return plant.GetModelInstanceName(body.model_instance())

    found = {
        frozenset((model(pair.id_A), model(pair.id_B)))
        for pair in query.ComputePointPairPenetration()
        if pair.depth > 1e-3
    }
    assert {frozenset(_welded_name(name) for name in pair) for pair in found} == deep_pairs(batch, index)


def _welded_name(name):
    """Drake hangs the geometry of a static SDF model on the world."""
    return "cafe_table_0" if name == "WorldModelInstance" else name


@DRAKE
def test_drake_rubs_as_we_do_and_has_contact_patches(folder, name):
    _, graph, _, _ = drake_scene(folder, 0, name)
    from pydrake.geometry import Role

    inspector = graph.model_inspector()
    geometries = inspector.GetAllGeometryIds(Role.kProximity)
    assert len(geometries) > 100
    for geometry in geometries:
        properties = inspector.GetProximityProperties(geometry)
        friction = properties.GetProperty("material", "coulomb_friction")
        assert (friction.static_friction(), friction.dynamic_friction()) == (0.6, 0.6)
        assert properties.HasProperty("hydroelastic", "compliance_type")


@pytest.mark.slow
@DRAKE
def test_drake_leaves_a_laid_table_still(folder, scenes, name):
    plant, _, diagram, context = drake_scene(folder, 0, name)
    from pydrake.systems.analysis import Simulator

    Simulator(diagram, context).AdvanceTo(0.1)
    assert (moved(scenes[0], drake_poses(plant, context, scenes[0])) < STILL).all()


# -- PyBullet ----------------------------------------------------------------------------------------


@pytest.fixture
def bullet():
    pybullet = pytest.importorskip("pybullet")
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(pybullet.DIRECT)
    yield client
    client.disconnect()


def bullet_bodies(bullet, folder, index):
    here = path_of(folder, index, "objects.json").parent
    bodies = {}
    for thing in json.loads((here / "objects.json").read_text())["objects"]:
        w, x, y, z = thing["quaternion_wxyz"]
        bodies[thing["name"]] = bullet.loadURDF(
            str(here / thing["bullet_urdf"]),
            thing["translation"],
            (x, y, z, w),
            useFixedBase=thing["welded"],
            flags=bullet.URDF_USE_INERTIA_FROM_FILE,
        )
    return bodies


def bullet_poses(bullet, bodies):
    """Poses of the link frames; what PyBullet calls a base pose is that of the principal axes of inertia."""
    poses = {}
    for name, body in bodies.items():
        position, turn = bullet.getBasePositionAndOrientation(body)
        _, _, _, center, axes = bullet.getDynamicsInfo(body, -1)[:5]
        rotation = Rotation.from_quat(turn) * Rotation.from_quat(axes).inv()
        poses[name] = transform(np.array(position) - rotation.apply(center), rotation.as_matrix())
    return poses


@SCENES
def test_pybullet_has_the_same_poses_and_masses(bullet, folder, scenes, index):
    bodies = bullet_bodies(bullet, folder, index)
    assert pose_error(scenes[index], bullet_poses(bullet, bodies)) < POSE
    for thing in scenes[index].objects:
        mass, friction, moments = bullet.getDynamicsInfo(bodies[thing.name], -1)[:3]
        assert mass == (0.0 if thing.welded else thing.asset.mass)
        assert friction**2 == pytest.approx(0.6)  # Bullet multiplies those of two bodies
        if not thing.welded:
            np.testing.assert_allclose(np.sort(moments), np.linalg.eigvalsh(thing.asset.inertia), rtol=1e-6)


@JUDGED
def test_pybullet_finds_the_same_overlaps(bullet, folder, batch, index):
    bodies = bullet_bodies(bullet, folder, index)
    found = set()
    for a, b in itertools.combinations(bodies, 2):
        if any(point[8] < -1e-3 for point in bullet.getClosestPoints(bodies[a], bodies[b], 0.0)):
            found.add(frozenset((a, b)))
    assert found == deep_pairs(batch, index)


def test_pybullet_leaves_a_laid_table_still(bullet, folder, scenes):
    bodies = bullet_bodies(bullet, folder, 0)
    bullet.setGravity(0.0, 0.0, -9.81)
    for _ in range(120):
        bullet.stepSimulation()
    assert (moved(scenes[0], bullet_poses(bullet, bodies)) < STILL).all()


# -- USD ---------------------------------------------------------------------------------------------


def usd_stage(folder, index):
    pytest.importorskip("pxr")
    from pxr import Usd

    return Usd.Stage.Open(str(folder / f"scene_{index:03d}.usda"))


@SCENES
def test_usd_has_the_same_poses_and_masses(folder, scenes, index):
    stage = usd_stage(folder, index)
    from pxr import UsdGeom, UsdPhysics

    cache = UsdGeom.XformCache()
    prims = {thing.name: stage.GetPrimAtPath(f"/World/{thing.name}") for thing in scenes[index].objects}
    poses = {name: np.array(cache.GetLocalToWorldTransform(prim)).T for name, prim in prims.items()}
    assert pose_error(scenes[index], poses) < POSE
    assert (UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)) == (1.0, "Z")
    for thing in scenes[index].objects:
        prim = prims[thing.name]
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI) != thing.welded
        if not thing.welded:
            mass = UsdPhysics.MassAPI(prim)
            axes = Rotation.from_quat(
                [mass.GetPrincipalAxesAttr().Get().real, *mass.GetPrincipalAxesAttr().Get().imaginary],
                scalar_first=True,
            ).as_matrix()
            inertia = (axes * np.array(mass.GetDiagonalInertiaAttr().Get())) @ axes.T
            assert mass.GetMassAttr().Get() == pytest.approx(thing.asset.mass)
            np.testing.assert_allclose(inertia, thing.asset.inertia, atol=1e-8)


@JUDGED
def test_usd_has_colliders_that_overlap_alike(folder, batch, index):
    stage = usd_stage(folder, index)
    from pxr import Usd, UsdGeom, UsdPhysics

    cache = UsdGeom.XformCache()
    parts: dict[str, list[np.ndarray]] = {}
    for prim in Usd.PrimRange(stage.GetPrimAtPath("/World")):
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"
            matrix = np.array(cache.GetLocalToWorldTransform(prim))
            points = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(), dtype=float)
            name = prim.GetPath().pathString.split("/")[2]
            parts.setdefault(name, []).append(points @ matrix[:3, :3] + matrix[3, :3])
    found = {
        frozenset((a, b))
        for a, b in itertools.combinations(parts, 2)
        if any(hull_overlap(first, second) > 1e-3 for first in parts[a] for second in parts[b])
    }
    assert found == deep_pairs(batch, index)


def hull_overlap(a, b):
    """How far (m) the hulls of two clouds of points must move to part: the origin's depth in their difference."""
    if (a.min(axis=0) > b.max(axis=0)).any() or (b.min(axis=0) > a.max(axis=0)).any():
        return 0.0
    difference = ConvexHull((a[:, None] - b[None]).reshape(-1, 3))
    return -difference.equations[:, 3].max()


# -- meshes and arrays -------------------------------------------------------------------------------


@SCENES
def test_glb_has_the_same_poses_colours_and_extent(folder, scenes, index):
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(path_of(folder, index, "scene.glb"))
    upright = loaded.graph.get("z_up")[0]
    np.testing.assert_array_equal(upright[:3, :3] @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])  # glTF has y up
    poses = {t.name: np.linalg.inv(upright) @ loaded.graph.get(t.name)[0] for t in scenes[index].objects}
    assert pose_error(scenes[index], poses) < POSE
    for thing in scenes[index].objects:
        mesh, original = loaded.geometry[loaded.graph.get(thing.name)[1]], thing.asset.visual
        np.testing.assert_allclose(mesh.bounds, original.bounds, atol=1e-6)
        shown = mesh.visual.to_color().vertex_colors[mesh.faces[:, 0], :3]
        np.testing.assert_array_equal(shown, original.visual.face_colors[:, :3])
        assert mesh.visual.material.metallicFactor == 0.0


@SCENES
def test_arrays_hold_the_scene_exactly(folder, batch, scenes, index):
    with np.load(path_of(folder, index, "scene.npz")) as arrays:  # allow_pickle is off
        found = dict(arrays)
    rows = zip(found["names"], found["translations"], found["rotations"], strict=True)
    assert pose_error(scenes[index], {str(name): transform(t, r) for name, t, r in rows}) == 0.0
    categories = batch.categories[index][~batch.is_empty[index]]
    assert found["categories"].tolist() == categories.tolist()
    assert found["asset_names"].tolist() == list(batch.scene_type.assets)
    assert str(found["scene_type"]) == "dimsum_table"
