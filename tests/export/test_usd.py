"""USD scenes: what UsdPhysics' own parser, Newton, MuJoCo and SimReady's rules find in them.

The tests of the last section run where Newton, mujoco-usd or simready-validate is installed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from scene_envs.export import export, place
from scene_envs.physics import make_ready
from scene_envs.physics.mujoco import SOLIMP, SOLREF
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import DIMSUM, laid_scene

pytest.importorskip("pxr")

FRICTION = 0.45
WELDED = ("cafe_table", "teapot", "steamer_bottom")
"""The table has no mass; the others have one, and are welded in these scenes all the same."""


@pytest.fixture(scope="module")
def scene():
    """The laid table with welded objects that have a mass."""
    batch = laid_scene()
    return place(SceneBatch(batch.tensor, replace(batch.scene_type, name="welded", welded=WELDED)))[0]


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """An export of that scene, moved after it was written."""
    batch = laid_scene()
    output = tmp_path_factory.mktemp("usd") / "written"
    export(
        SceneBatch(batch.tensor, replace(batch.scene_type, name="welded", welded=WELDED)),
        output,
        "usd",
        friction=FRICTION,
    )
    return output.rename(output.with_name("read"))


@pytest.fixture(scope="module")
def stage(root):
    from pxr import Usd

    return Usd.Stage.Open(str(root / "scene_000.usda"))


@pytest.fixture(scope="module")
def parsed(stage):
    """What UsdPhysics' parser finds: for each type of object, descriptions by path."""
    from pxr import UsdPhysics

    load = getattr(UsdPhysics, "UsdPhysicsLoadStageFromPrimRange", None) or UsdPhysics.LoadUsdPhysicsFromRange
    found = load(stage, ["/"])
    return {
        str(kind).rsplit(".", 1)[-1]: dict(zip(map(str, paths), descriptions, strict=True))
        for kind, (paths, descriptions) in found.items()
    }


def file_of(root, name):
    return root / "assets" / name / "usd" / f"{name}.usda"


def inertia_of(mass) -> np.ndarray:
    """(3, 3) inertia in the frame of the body, from a MassAPI."""
    turn = mass.GetPrincipalAxesAttr().Get()
    axes = Rotation.from_quat([turn.real, *turn.imaginary], scalar_first=True).as_matrix()
    return (axes * np.array(mass.GetDiagonalInertiaAttr().Get())) @ axes.T


# -- what the parser of UsdPhysics finds ---------------------------------------------------------------


def test_every_collider_has_the_friction_of_the_export(scene, stage, parsed):
    from pxr import UsdPhysics, UsdShade

    shapes, materials = parsed["MeshShape"], parsed["RigidBodyMaterial"]
    assert len(shapes) == sum(len(thing.asset.fine) for thing in scene.objects)
    for path, shape in shapes.items():
        (bound,) = map(str, shape.materials)
        assert materials[bound].staticFriction == materials[bound].dynamicFriction == pytest.approx(FRICTION)
        assert shape.approximation == UsdPhysics.Tokens.convexHull
        binding = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path))
        assert str(binding.ComputeBoundMaterial()[0].GetPath()) == bound  # for all purposes, which MuJoCo reads


def test_objects_are_bodies_with_their_colliders_and_welded_ones_static_colliders(scene, parsed):
    bodies, shapes = parsed["RigidBody"], parsed["MeshShape"]
    assert set(bodies) == {f"/World/{thing.name}" for thing in scene.objects if not thing.welded}
    assert {thing.asset.name for thing in scene.objects if thing.welded} == set(WELDED)
    for thing in scene.objects:
        owners = {str(shape.rigidBody) for path, shape in shapes.items() if f"/{thing.name}/" in path}
        assert owners == ({""} if thing.welded else {f"/World/{thing.name}"})
        if not thing.welded:
            body = bodies[f"/World/{thing.name}"]
            turn = Rotation.from_quat([body.rotation.real, *body.rotation.imaginary], scalar_first=True)
            np.testing.assert_allclose(turn.as_matrix(), thing.rotation, atol=1e-6)
            np.testing.assert_allclose(body.position, thing.translation, atol=1e-6)


def test_mass_properties_are_those_of_the_assets(scene, root, stage):
    from pxr import Usd, UsdPhysics

    for thing in scene.objects:
        asset_stage = Usd.Stage.Open(str(file_of(root, thing.asset.name)))
        alone = asset_stage.GetDefaultPrim()
        assert alone.HasAPI(UsdPhysics.RigidBodyAPI) == (thing.asset.mass > 0)
        for prim in [alone] * (thing.asset.mass > 0) + [stage.GetPrimAtPath(f"/World/{thing.name}")] * (
            not thing.welded
        ):
            mass = UsdPhysics.MassAPI(prim)
            assert mass.GetMassAttr().Get() == pytest.approx(thing.asset.mass, rel=1e-6)
            np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), thing.asset.center_of_mass, atol=1e-8)
            largest = np.linalg.norm(thing.asset.inertia, 2)
            np.testing.assert_allclose(inertia_of(mass), thing.asset.inertia, atol=1e-6 * largest)


def test_contact_settings_are_schemas_of_mujoco_and_newton(stage, parsed):
    for path in parsed["MeshShape"]:
        prim = stage.GetPrimAtPath(path)
        assert {"MjcCollisionAPI", "NewtonMeshCollisionAPI"} <= set(
            prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems()
        )
        assert tuple(prim.GetAttribute("mjc:solref").Get()) == SOLREF
        assert tuple(prim.GetAttribute("mjc:solimp").Get()) == SOLIMP
        assert prim.GetAttribute("newton:contactGap").Get() == 0.0
    settings = stage.GetPrimAtPath("/World/physics_scene")
    assert settings.GetAttribute("mjc:option:cone").Get() == "elliptic"
    assert settings.GetAttribute("newton:timeStepsPerSecond").Get() == 500


# -- files -------------------------------------------------------------------------------------------


def test_every_reference_stays_below_the_folder_of_the_scene(root, stage):
    from pathlib import Path

    layers = [layer for layer in stage.GetUsedLayers() if not layer.anonymous]
    assert len(layers) == 1 + len({prim.name for prim in (root / "assets").iterdir()})
    assert all(root.resolve() in Path(layer.realPath).resolve().parents for layer in layers)
    text = (root / "scene_000.usda").read_text()
    assert text.count("@./assets/") * 2 == text.count("@") - text.count("@</") == 2 * text.count("prepend references")
    assert {path.name for path in root.iterdir()} == {"assets", "export.json", "scene_000.usda"}


def test_the_same_scenes_give_the_same_bytes(root, tmp_path):
    batch = laid_scene()
    batch = SceneBatch(batch.tensor, replace(batch.scene_type, name="welded", welded=WELDED))
    found = []
    for folder in ("one", "two", "two"):
        export(batch, tmp_path / folder, "usd", friction=FRICTION)
        files = [path for path in (tmp_path / folder).rglob("*") if path.is_file()]
        found.append({path.relative_to(tmp_path / folder): path.read_bytes() for path in files})
    assert found[0] == found[1] == found[2]
    assert set(found[0]) == {path.relative_to(root) for path in root.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["teacup", "cafe_table"])
def test_an_asset_is_labelled_pictured_and_shaded(root, name):
    from pxr import Usd, UsdGeom, UsdShade

    path, asset = file_of(root, name), DIMSUM.library[name]
    stage = Usd.Stage.Open(str(path))
    prim, material = stage.GetDefaultPrim(), stage.GetPrimAtPath(f"/{name}/surface")
    assert list(prim.GetAttribute("semantics:labels:class").Get()) == [asset.display_name]
    code = {"teacup": "Q81707", "cafe_table": "Q14748"}[name]
    assert list(prim.GetAttribute("semantics:labels:wikidata_qcode").Get()) == [code]
    fields = stage.GetRootLayer().customLayerData["SimReady_Metadata"]
    np.testing.assert_allclose(fields["asset_extents"], np.ptp(asset.visual.bounds, axis=0), rtol=1e-6)
    assert (fields["qcode"], fields.get("mass")) == (code, asset.mass or None)
    visual = stage.GetPrimAtPath(f"/{name}/visual")
    assert UsdShade.MaterialBindingAPI(visual).ComputeBoundMaterial()[0].GetPrim() == material
    shader = UsdShade.Material(material).ComputeSurfaceSource()[0]
    assert shader.GetShaderId() == "UsdPreviewSurface"
    for mesh in (UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)):
        normals = np.array(mesh.GetNormalsAttr().Get())
        points, faces = np.array(mesh.GetPointsAttr().Get()), np.array(mesh.GetFaceVertexIndicesAttr().Get())
        if mesh.GetNormalsInterpolation() == UsdGeom.Tokens.uniform:
            corners = points[faces.reshape(-1, 3)]
            wide = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            assert (np.einsum("ij,ij->i", wide, normals) > 0.99 * np.linalg.norm(wide, axis=1) - 1e-9).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
    picture = np.asarray(Image.open(path.parent / ".thumbs" / "256x256" / f"{name}.usda.png"), dtype=float)
    assert picture.shape == (256, 256, 3)
    background = picture[:, :1]  # the object is whole in the picture, and fills a good part of it
    differs = np.abs(picture - background).max(axis=2) > 12.0
    assert not differs[[0, -1]].any()
    assert not differs[:, [0, -1]].any()
    assert differs.mean() > 0.05


# -- other readers, where they are installed -----------------------------------------------------------


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """A ready scene with a welded teapot, and its export."""
    batch = make_ready(laid_scene()).batch
    batch = SceneBatch(batch.tensor, replace(batch.scene_type, name="welded", welded=("cafe_table", "teapot")))
    output = tmp_path_factory.mktemp("ready")
    export(batch, output, "usd")
    return place(batch)[0], str(output / "scene_000.usda")


def assert_body(thing, mass, inertia, center, matrix):
    """Mass (kg), inertia about the centre of mass (3, 3), centre (3,) and pose (4, 4) of an object, as read."""
    assert mass == pytest.approx(thing.asset.mass, rel=1e-6)
    largest = np.linalg.norm(thing.asset.inertia, 2)
    np.testing.assert_allclose(inertia, thing.asset.inertia, atol=1e-6 * largest)
    np.testing.assert_allclose(center, thing.asset.center_of_mass, atol=1e-8)
    np.testing.assert_allclose(matrix, thing.matrix, atol=1e-6)


def test_newton_reads_the_scene_and_leaves_it_still(ready):
    newton = pytest.importorskip("newton")
    scene, path = ready
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    found = builder.add_usd(path)
    model, bodies = builder.finalize(device="cpu"), found["path_body_map"]
    assert set(bodies) == {f"/World/{thing.name}" for thing in scene.objects if not thing.welded}
    collides = (model.shape_flags.numpy() & int(newton.ShapeFlags.COLLIDE_SHAPES)) != 0
    assert collides.sum() == sum(len(thing.asset.fine) for thing in scene.objects)
    np.testing.assert_allclose(model.shape_material_mu.numpy()[collides], 0.6, rtol=1e-6)
    static = sum(len(thing.asset.fine) for thing in scene.objects if thing.welded)
    assert (model.shape_body.numpy()[collides] == -1).sum() == static
    poses = model.body_q.numpy()
    for thing in scene.objects:
        if not thing.welded:
            i = bodies[f"/World/{thing.name}"]
            matrix = np.eye(4)
            matrix[:3, 3], matrix[:3, :3] = poses[i, :3], Rotation.from_quat(poses[i, 3:]).as_matrix()
            facts = model.body_mass.numpy()[i], model.body_inertia.numpy()[i], model.body_com.numpy()[i]
            assert_body(thing, *facts, matrix)
    solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True)
    state, other = model.state(), model.state()
    for _ in range(round(2.0 / found["physics_dt"])):
        state.clear_forces()
        solver.step(state, other, model.control(), None, found["physics_dt"])
        state, other = other, state
    assert np.linalg.norm(state.body_q.numpy()[:, :3] - poses[:, :3], axis=1).max() < 1e-4


def test_mujoco_reads_the_scene_and_leaves_it_still(ready):
    pytest.importorskip("mujoco._usd")
    import mujoco

    scene, path = ready
    model = mujoco.MjSpec.from_file(path).compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = {model.body(i).name.rsplit("/", 1)[-1]: i for i in range(1, model.nbody)}
    assert set(names) == {thing.name for thing in scene.objects if not thing.welded}
    collides = model.geom_contype != 0
    assert collides.sum() == sum(len(thing.asset.fine) for thing in scene.objects)
    np.testing.assert_allclose(model.geom_friction[collides, 0], 0.6, rtol=1e-6)
    for thing in scene.objects:
        if not thing.welded:
            i = names[thing.name]
            axes = Rotation.from_quat(model.body_iquat[i], scalar_first=True).as_matrix()
            matrix = np.eye(4)
            matrix[:3, 3], matrix[:3, :3] = data.xpos[i], data.xmat[i].reshape(3, 3)
            assert_body(thing, model.body_mass[i], (axes * model.body_inertia[i]) @ axes.T, model.body_ipos[i], matrix)
    before = data.xpos.copy()
    while data.time < 2.0:
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.xpos - before, axis=1).max() < 1e-4


def test_assets_pass_the_rules_of_simready(root):
    simready = pytest.importorskip("simready.validate")
    simready.initialize(rules_and_requirements_paths=[], features_paths=[], profiles_paths=[])
    settings = {"profile_id": "Robotics-Prop", "profile_version": "4.0.0"}
    try:
        for name in ("teacup", "dinner_plate", "steamer_lid"):
            result = simready.validate_asset(simready.AssetValidationConfig(str(file_of(root, name)), **settings))
            blocking = {
                key: value["failing requirements"]
                for key, value in result.features_summary.items()
                if "failing requirements" in value
            }
            assert blocking == {}
            passed = {key for key, value in result.features_summary.items() if value["passed"]}
            rigid = {f"FET_003_{engine}" for engine in ("STANDARD", "MUJOCO", "NEWTON", "PHYSX")}
            assert rigid | {"FET_000_STANDARD", "FET_001_STANDARD", "FET_006_STANDARD", "FET_033_STANDARD"} <= passed
        result = simready.validate_asset(simready.AssetValidationConfig(str(root / "scene_000.usda"), **settings))
        blocking = {key for key, value in result.features_summary.items() if "failing requirements" in value}
        assert all(key.startswith(("FET_000", "FET_033")) for key in blocking)  # folder and metadata of a single prop
    finally:
        simready.destroy()
