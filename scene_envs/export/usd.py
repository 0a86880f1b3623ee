"""USD with UsdPhysics: one stage per scene, over one SimReady prop per asset. Needs usd-core.

What a simulator must know beyond UsdPhysics stands in the applied schemas of MuJoCo and Newton, which usd-core writes
without their packages: contact on each collider, step and friction cone on the physics scene.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.base import RECIPES, Asset
from scene_envs.assets.shapes import pose_of
from scene_envs.export.placed import (
    AssetFiles,
    Light,
    PlacedObject,
    PlacedScene,
    camera_axes,
    face_colors,
    linear,
    pattern_uv,
    quaternion,
    visual_mesh,
)
from scene_envs.export.urdf import relative
from scene_envs.physics.mujoco import SOLIMP, SOLREF, TIMESTEP
from scene_envs.physics.parts import GRAVITY, principal_inertia
from scene_envs.scene_types import Camera, SceneType

_SCENE = {
    "mjc:option:cone": ("token", "elliptic"),
    "mjc:option:impratio": ("double", 10.0),
    "mjc:option:integrator": ("token", "implicitfast"),
    "mjc:flag:multiccd": ("bool", True),
}
"""Attributes of MjcSceneAPI; Newton reads the step from ``newton:timeStepsPerSecond``."""
_CONTACT = {"mjc:solref": ("double[]", list(SOLREF)), "mjc:solimp": ("double[]", list(SOLIMP))}
"""Attributes of MjcCollisionAPI."""
_GAP = {"newton:contactGap": ("float", 0.0)}
"""Attribute of NewtonMeshCollisionAPI. Newton's default is 10 cm, which makes MuJoCo's solver throw stacks apart."""
_QCODES = {
    "apple": "Q89", "board_game": "Q131436", "book": "Q571", "bottle": "Q80228", "bowl": "Q153988", "bread": "Q7802",
    "chair": "Q15026", "fork": "Q81881", "knife": "Q32489", "mug": "Q386215", "pear": "Q13099586", "plate": "Q57216",
    "spoon": "Q81895", "table": "Q14748", "teacup": "Q81707", "teapot": "Q245005", "teaspoon": "Q81895",
}  # fmt: skip
"""Wikidata items by a word of the asset's name."""
_PHYSICAL_OBJECT = "Q223557"
_LAMP, _SKY = 1000.0, 300.0
"""Intensities (nit) of the lamp, and of the light from all sides that is with it."""
_THUMBNAIL = 256
"""Width and height of an asset's picture, pixels."""


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene_000.usda`` beside the folder ``assets``, so that every reference stays below the file's own folder.

    One prim under ``/World`` per object; welded ones are colliders without a rigid body; units m and kg, z up. With
    joints, the prim is an articulation of a prim for each link, and a fixed joint holds the first at the world. A light
    or a camera that was drawn for the scene is ``/World/lamp``, with ``/World/sky``, or ``/World/camera``.
    """
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics

    path = folder.with_suffix(".usda")
    stage = _new_stage(path)
    world = UsdGeom.Xform.Define(stage, "/World")
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(world.GetPrim())
    physics = UsdPhysics.Scene.Define(stage, "/World/physics_scene")
    physics.CreateGravityDirectionAttr(Gf.Vec3f(0, 0, -1))
    physics.CreateGravityMagnitudeAttr(GRAVITY)
    _apply(physics, "MjcSceneAPI", _SCENE)
    _apply(physics, "NewtonSceneAPI", {"newton:timeStepsPerSecond": ("int", round(1.0 / TIMESTEP))})
    for item in scene.objects:
        prims = [_place(UsdGeom.Xform.Define(stage, f"/World/{item.name}"), item.matrix)]
        if item.joints:
            names = [files.name(item.asset), *(joint.link for joint in item.joints)]
            prims = [
                _place(UsdGeom.Xform.Define(stage, f"/World/{item.name}/{name}"), frame)
                for name, frame in zip(names, item.frames, strict=True)
            ]
            _add_joints(stage, item, [prim.GetPath() for prim in prims])
        for prim, piece in zip(prims, item.pieces, strict=True):
            asset_file = files.once(piece.asset, "usd", partial(_write_asset, piece.asset, files, scene.scene_type))
            prim.GetReferences().AddReference(Sdf.Reference(f"./{relative(asset_file, path.parent)}"))
            if item.welded and not item.joints:  # MuJoCo and Newton read rigidBodyEnabled=false as a free body
                prim.RemoveAPI(UsdPhysics.RigidBodyAPI)
                prim.RemoveAPI(UsdPhysics.MassAPI)
            elif piece.mass != piece.asset.mass:
                _apply_body(prim, replace(piece.asset, mass=piece.mass, inertia=piece.inertia))
            if item.friction != files.friction:
                surface = UsdPhysics.MaterialAPI.Apply(stage.OverridePrim(prim.GetPath().AppendChild("surface")))
                surface.CreateStaticFrictionAttr(item.friction)
                surface.CreateDynamicFrictionAttr(item.friction)
            if piece.tinted or piece.texture != "none":
                _change_look(stage, str(prim.GetPath()), piece, files, path.parent)
    if scene.light != Light():
        _add_light(stage, scene.light)
    if scene.camera != scene.scene_type.camera:
        _add_camera(stage, scene.camera)
    stage.GetRootLayer().Save()
    return path


def _change_look(stage: Any, prim: str, item: PlacedObject, files: AssetFiles, folder: Path) -> None:
    """The object's texture and colour over those of its asset: a palette without, and an image with a texture."""
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    if item.texture == "none":
        palette = np.unique(face_colors(visual_mesh(item.asset)), axis=0) / 255.0
        colors = Vt.Vec3fArray.FromNumpy(linear(palette * item.color).astype(np.float32))
        UsdGeom.PrimvarsAPI(stage.OverridePrim(f"{prim}/visual")).GetPrimvar("displayColor").Set(colors)
        return
    reader = _define_shader(stage, f"{prim}/surface/st", "UsdPrimvarReader_float2", {"varname": ("String", "st")})
    image = f"./{relative(files.visual(item.asset, item.texture).with_suffix('.png'), folder)}"
    values = {"file": ("Asset", image), "scale": ("Float4", Gf.Vec4f(*linear(item.color).tolist(), 1.0))}
    texture = _define_shader(stage, f"{prim}/surface/texture", "UsdUVTexture", values)
    place = texture.CreateInput("st", Sdf.ValueTypeNames.Float2)
    place.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
    shader = UsdShade.Shader(stage.OverridePrim(f"{prim}/surface/shader"))
    color = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))


def _add_light(stage: Any, light: Light) -> None:
    from pxr import Gf, UsdLux

    up = np.eye(3)[np.argmin(np.abs(light.direction))]
    lamp = UsdLux.DistantLight.Define(stage, "/World/lamp")
    lamp.CreateIntensityAttr(_LAMP * light.intensity)
    lamp.CreateColorAttr(Gf.Vec3f(*linear(light.color).tolist()))
    _place(lamp, pose_of(np.zeros(3), camera_axes(np.zeros(3), light.direction, up)))
    UsdLux.DomeLight.Define(stage, "/World/sky").CreateIntensityAttr(_SKY)


def _add_camera(stage: Any, camera: Camera) -> None:
    from pxr import Gf, UsdGeom

    view = UsdGeom.Camera.Define(stage, "/World/camera")
    height = view.GetHorizontalApertureAttr().Get() * camera.height / camera.width
    view.CreateVerticalApertureAttr(height)
    view.CreateFocalLengthAttr(0.5 * height / float(np.tan(np.radians(camera.fov_y) / 2.0)))
    view.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1000.0))
    _place(view, pose_of(camera.position, camera_axes(camera.position, camera.target, camera.up)))


def _place(prim: Any, pose: Array) -> Any:
    """The prim, put at a pose (4, 4) in the frame of the prim above it."""
    from pxr import Gf, UsdGeom

    prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*pose[:3, 3].tolist()))
    prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*quaternion(pose[:3, :3]).tolist()))
    return prim.GetPrim()


def _add_joints(stage: Any, item: PlacedObject, paths: list[Any]) -> None:
    """The joints of the links at these paths, below the object, and one that holds the first at the world."""
    from pxr import Gf, Sdf, UsdGeom, UsdPhysics

    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath(paths[0]))  # MuJoCo takes a prim of no link for a body
    folder = UsdGeom.Scope.Define(stage, f"/World/{item.name}/joints").GetPath()
    weld = UsdPhysics.FixedJoint.Define(stage, folder.AppendChild(f"{paths[0].name}_weld"))
    made: list[tuple[Any, list[Any], Array, Array]] = [(weld, paths[:1], item.matrix, np.eye(4))]
    for path, joint in zip(paths[1:], item.joints, strict=True):
        is_slide = joint.kind == "prismatic"
        kind = UsdPhysics.PrismaticJoint if is_slide else UsdPhysics.RevoluteJoint
        found = kind.Define(stage, folder.AppendChild(joint.name))
        from_x = Rotation.align_vectors(joint.axis, (1.0, 0.0, 0.0))[0].as_matrix()
        turn = pose_of(np.zeros(3), from_x)  # from the x axis to that of the joint
        made.append((found, [paths[joint.parent], path], joint.pose @ turn, turn))
        degrees = 1.0 if is_slide else np.degrees(1.0)
        found.CreateAxisAttr(UsdPhysics.Tokens.x)
        found.CreateLowerLimitAttr(joint.limits[0] * degrees)
        found.CreateUpperLimitAttr(joint.limits[1] * degrees)
        found.GetPrim().AddAppliedSchema("NewtonJointAPI")  # MuJoCo reads it as well
        for key, value in (("damping", joint.damping / degrees), ("friction", joint.friction)):
            found.GetPrim().CreateAttribute(f"newton:{key}", Sdf.ValueTypeNames.Float, False).Set(value)
    for found, ends, *frames in made:
        for end, relation in zip(reversed(ends), (found.CreateBody1Rel(), found.CreateBody0Rel()), strict=False):
            relation.SetTargets([end])
        for index, frame in enumerate(frames):
            place, axes = Gf.Vec3f(*frame[:3, 3].tolist()), Gf.Quatf(*quaternion(frame[:3, :3]).tolist())
            found.GetPrim().GetAttribute(f"physics:localPos{index}").Set(place)
            found.GetPrim().GetAttribute(f"physics:localRot{index}").Set(axes)


def _write_asset(asset: Asset, files: AssetFiles, scene_type: SceneType, folder: Path) -> Path:
    """``usd/<name>.usda``: a rigid body of a coloured mesh and convex colliders of purpose *guide*, and its picture."""
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

    name = files.name(asset)
    path = folder / "usd" / f"{name}.usda"
    stage = _new_stage(path)
    root = UsdGeom.Xform.Define(stage, f"/{name}")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    code = next((_QCODES[word] for word in _QCODES if f"_{word}_" in f"_{asset.name}_"), _PHYSICAL_OBJECT)
    _label(root, "class", asset.display_name)
    _label(root, "wikidata_qcode", code)
    if asset.mass > 0:
        _apply_body(root.GetPrim(), asset)
    material = _define_material(stage, f"/{name}/surface", files.friction)
    mesh = visual_mesh(asset)
    visual = _define_mesh(stage, f"/{name}/visual", mesh.vertices, mesh.faces)
    palette, cells = np.unique(face_colors(mesh), axis=0, return_inverse=True)
    primvars, names = UsdGeom.PrimvarsAPI(visual), Sdf.ValueTypeNames
    primvar = primvars.CreatePrimvar("displayColor", names.Color3fArray, UsdGeom.Tokens.uniform)
    primvar.Set(Vt.Vec3fArray.FromNumpy(linear(palette / 255.0).astype(np.float32)))
    primvar.SetIndices(Vt.IntArray.FromNumpy(cells.ravel().astype(np.int32)))
    place = primvars.CreatePrimvar("st", names.TexCoord2fArray, UsdGeom.Tokens.vertex)
    place.Set(Vt.Vec2fArray.FromNumpy(pattern_uv(mesh).astype(np.float32)))
    visual.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(mesh.vertex_normals, dtype=np.float32)))
    visual.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    UsdShade.MaterialBindingAPI.Apply(visual.GetPrim()).Bind(material)
    colliders = UsdGeom.Xform.Define(stage, f"/{name}/collision")
    colliders.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for index, part in enumerate(asset.fine):
        piece = _define_mesh(stage, f"/{name}/collision/part_{index:02d}", part.vertices, part.faces)
        normals = trimesh.Trimesh(part.vertices, part.faces, process=False).face_normals
        piece.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
        piece.SetNormalsInterpolation(UsdGeom.Tokens.uniform)
        piece.CreateDisplayColorAttr([Gf.Vec3f(0.4, 0.7, 0.4)])
        UsdPhysics.CollisionAPI.Apply(piece.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(piece.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        _apply(piece, "MjcCollisionAPI", _CONTACT)
        _apply(piece, "NewtonMeshCollisionAPI", _GAP)
        binding = UsdShade.MaterialBindingAPI.Apply(piece.GetPrim())  # readers look on the collider itself, and
        binding.Bind(material)  # some of them read the binding for all purposes only
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")
    stage.GetRootLayer().customLayerData = _metadata(asset, code)
    stage.GetRootLayer().Save()
    if asset.name in scene_type.library.names:
        _write_thumbnail(asset, scene_type, path.parent / ".thumbs" / "256x256" / f"{path.name}.png")
    return path


def _new_stage(path: Path) -> Any:
    """An empty stage in metres and kilograms with z up, replacing the file at ``path``."""
    from pxr import Sdf, Usd, UsdGeom, UsdPhysics

    layer = Sdf.Layer.Find(str(path))  # a layer that this process wrote is still in memory
    if layer:
        layer.Clear()
    else:
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        layer = Sdf.Layer.CreateNew(str(path))
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    return stage


def _apply(schema: Any, name: str, attributes: dict[str, tuple[str, Any]]) -> None:
    """Apply the API schema ``name``, whose package need not be installed; values (type, value) by attribute."""
    from pxr import Sdf

    prim = schema.GetPrim()
    prim.AddAppliedSchema(name)
    for key, (kind, value) in attributes.items():
        prim.CreateAttribute(key, Sdf.ValueTypeNames.Find(kind), False, Sdf.VariabilityUniform).Set(value)


def _label(schema: Any, taxonomy: str, label: str) -> None:
    """UsdSemantics' label of one taxonomy, which the prims below inherit."""
    from pxr import Sdf

    schema.GetPrim().AddAppliedSchema(f"SemanticsLabelsAPI:{taxonomy}")
    schema.GetPrim().CreateAttribute(f"semantics:labels:{taxonomy}", Sdf.ValueTypeNames.TokenArray, False).Set([label])


def _define_material(stage: Any, path: str, friction: float) -> Any:
    """A matt surface in the mesh's own colours, with the friction of contacts."""
    from pxr import Gf, Sdf, UsdPhysics, UsdShade

    material = UsdShade.Material.Define(stage, path)
    _label(material, "material", "unspecified")
    values = {"varname": ("String", "displayColor"), "fallback": ("Float3", Gf.Vec3f(0.5, 0.5, 0.5))}
    reader = _define_shader(stage, f"{path}/colors", "UsdPrimvarReader_float3", values)
    values = {"roughness": ("Float", 0.7), "metallic": ("Float", 0.0)}
    shader = _define_shader(stage, f"{path}/shader", "UsdPreviewSurface", values)
    color = shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    surface = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    surface.CreateStaticFrictionAttr(friction)
    surface.CreateDynamicFrictionAttr(friction)
    return material


def _define_shader(stage: Any, path: str, kind: str, values: dict[str, tuple[str, Any]]) -> Any:
    """A shader of the given kind; values (type, value) by input."""
    from pxr import Sdf, UsdShade

    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    for name, (kind_of, value) in values.items():
        shader.CreateInput(name, getattr(Sdf.ValueTypeNames, kind_of)).Set(value)
    return shader


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


def _apply_body(prim: Any, asset: Asset) -> None:
    """A rigid body with the mass properties of the asset."""
    from pxr import Gf, UsdPhysics

    UsdPhysics.RigidBodyAPI.Apply(prim)
    moments, axes = principal_inertia(asset.inertia)
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(asset.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*asset.center_of_mass.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*quaternion(axes).tolist()))


def _metadata(asset: Asset, code: str) -> dict[str, Any]:
    """SimReady's fields; the date is left open, so that the same export has the same bytes, and mass where it is 0."""
    from pxr import Gf

    extents = np.ptp(visual_mesh(asset).vertices, axis=0)
    fields = {
        "asset_name": asset.name,
        "asset_type": "prop",
        "category": asset.display_name,
        "qcode": code,
        "source_file": f"asset {asset.name!r} of scene_envs",
        "author": "The SceneEnvs authors" if asset.name in RECIPES else "not stated",
        "asset_license": "MIT" if asset.name in RECIPES else "not stated",
        "usd_date_generated": "not stated",
        "rigid_body_count": int(asset.mass > 0),
        "asset_extents": Gf.Vec3f(*extents.tolist()),
        "validation": {"profile": "Robotics-Prop", "profile_version": "4.0.0"},
    }
    if asset.mass > 0:
        fields["mass"] = float(asset.mass)
    outside = ("asset_name", "asset_type", "source_file", "usd_date_generated")  # rules look for these in both places
    return {"SimReady_Metadata": fields} | {key: fields[key] for key in outside}


def _write_thumbnail(asset: Asset, scene_type: SceneType, path: Path) -> None:
    """A picture of the asset, by the project's own renderer."""
    from PIL import Image

    from scene_envs.render.pictures import draw_picture
    from scene_envs.render.raster import Pinhole
    from scene_envs.render.stage import Stage, fit_camera, frame_scene_type

    points = np.asarray(visual_mesh(asset).vertices, dtype=np.float64)
    low, high = tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist())
    alone = replace(scene_type, slots=1, welded=(), fixed=(), workspace=(low, high))
    position, target = fit_camera(points, frame_scene_type(alone).to_camera, 28.0, 1.0, 0.06)
    x, y = tuple(position.tolist()), tuple(target.tolist())
    camera = Pinhole.at(x, y, (0.0, 0.0, 1.0), 28.0, _THUMBNAIL, _THUMBNAIL)
    stage = Stage((asset.name,), scene_type.asset_folders)
    stage.place(np.zeros((1, 3)), np.eye(3)[None], np.zeros(1, dtype=np.int64))
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(draw_picture(stage, camera, alone, np.zeros(1, dtype=bool))).save(path)
