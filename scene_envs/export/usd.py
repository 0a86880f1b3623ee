"""USD with UsdPhysics: one stage per scene, over one file per asset. Needs usd-core."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset
from scene_envs.export.placed import AssetFiles, PlacedScene, face_colors, quaternion, visual_mesh
from scene_envs.export.urdf import relative
from scene_envs.physics.parts import GRAVITY, principal_inertia


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.usda``: one prim under ``/World`` per object, a rigid body unless it is welded; metres, z up."""
    from pxr import Gf, Sdf, UsdGeom, UsdPhysics

    path = folder / "scene.usda"
    stage = _new_stage(path)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    physics = UsdPhysics.Scene.Define(stage, "/World/physics_scene")
    physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    physics.CreateGravityMagnitudeAttr(GRAVITY)
    for item in scene.objects:
        prim = UsdGeom.Xform.Define(stage, f"/World/{item.name}")
        asset_file = files.once(item.asset, "usd", partial(_write_asset, item.asset, files))
        prim.GetPrim().GetReferences().AddReference(Sdf.Reference(relative(asset_file, folder)))
        prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*item.translation.tolist()))
        w, x, y, z = item.quaternion.tolist()
        prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
        if not item.welded:
            UsdPhysics.RigidBodyAPI.Apply(prim.GetPrim())
            _apply_mass(prim.GetPrim(), replace(item.asset, mass=item.mass, inertia=item.inertia))
        if item.friction != files.friction:
            surface = UsdPhysics.MaterialAPI.Apply(stage.OverridePrim(f"/World/{item.name}/surface"))
            surface.CreateStaticFrictionAttr(item.friction)
            surface.CreateDynamicFrictionAttr(item.friction)
    stage.GetRootLayer().Save()
    return path


def _write_asset(asset: Asset, files: AssetFiles, folder: Path) -> Path:
    """``<name>.usda``: a coloured mesh, and convex colliders of purpose *guide*; the scene's file makes it a body."""
    from pxr import Gf, Sdf, UsdGeom, UsdPhysics, UsdShade, Vt

    name = files.name(asset)
    path = folder / f"{name}.usda"
    stage = _new_stage(path)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    mesh = visual_mesh(asset)
    visual = _define_mesh(stage, f"/{name}/visual", mesh.vertices, mesh.faces)
    colors = face_colors(mesh) / 255.0
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # USD keeps linear colour
    primvar = UsdGeom.PrimvarsAPI(visual).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.uniform
    )
    primvar.Set(Vt.Vec3fArray.FromNumpy(linear.astype(np.float32)))
    visual.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(mesh.vertex_normals, dtype=np.float32)))
    visual.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    material = UsdShade.Material.Define(stage, f"/{name}/surface")
    surface = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    surface.CreateStaticFrictionAttr(files.friction)
    surface.CreateDynamicFrictionAttr(files.friction)
    surface.CreateRestitutionAttr(0.0)
    colliders = UsdGeom.Xform.Define(stage, f"/{name}/collision")
    colliders.CreatePurposeAttr(UsdGeom.Tokens.guide)
    binding = UsdShade.MaterialBindingAPI.Apply(colliders.GetPrim())
    binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    for index, part in enumerate(asset.fine):
        piece = _define_mesh(stage, f"/{name}/collision/part_{index:02d}", part.vertices, part.faces)
        UsdPhysics.CollisionAPI.Apply(piece.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(piece.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        piece.CreateDisplayColorAttr([Gf.Vec3f(0.4, 0.7, 0.4)])
    stage.GetRootLayer().Save()
    return path


def _new_stage(path: Path) -> Any:
    """An empty stage in metres and kilograms with z up, replacing the file at ``path``."""
    from pxr import Sdf, Usd, UsdGeom, UsdPhysics

    layer = Sdf.Layer.Find(str(path))  # a layer that this process wrote is still in memory
    if layer:
        layer.Clear()
    else:
        path.unlink(missing_ok=True)
        layer = Sdf.Layer.CreateNew(str(path))
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    return stage


def _define_mesh(stage: Any, path: str, vertices: Array, faces: Any) -> Any:
    from pxr import UsdGeom, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(vertices, dtype=np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, dtype=np.int32).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    return mesh


def _apply_mass(prim: Any, asset: Asset) -> None:
    from pxr import Gf, UsdPhysics

    moments, axes = principal_inertia(asset.inertia)
    w, x, y, z = quaternion(axes).tolist()
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(asset.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*asset.center_of_mass.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(w, x, y, z))
