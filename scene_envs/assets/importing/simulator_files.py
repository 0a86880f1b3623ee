"""Readers of MJCF, by MuJoCo's own compiler, and of USD with UsdPhysics: one body at zero joint positions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.importing.limits import check_file, check_triangles
from scene_envs.assets.importing.mesh_files import (
    Y_UP,
    Color,
    Model,
    Shape,
    cut_polygons,
    heavier,
    merged_inertial,
    moved_inertial,
    pose_of,
)
from scene_envs.assets.importing.solids import solid_of
from scene_envs.assets.shapes import MassProperties
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError

_LEFT_OUT = ["nu actuators", "nsensor sensors", "ntendon tendons", "neq constraints", "nflex flexes", "nskin skins"]
"""The sizes of a model in MuJoCo that count what an asset does not have."""


def read_mjcf(path: Path) -> Model:
    """The one body of an MJCF file, with those below it, as MuJoCo compiles them, in the frame of that body; movable
    joints are frozen at their reference. A body without a free joint is welded. Raises CorruptFileError for a file that
    MuJoCo does not compile, and InvalidInputError for several bodies or none.
    """
    import mujoco

    check_file(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for mesh in spec.meshes:
            check_file(path.parent / spec.meshdir / mesh.file)
        model: Any = spec.compile()
    except ValueError as error:
        raise CorruptFileError(f"{path} cannot be read as MJCF: {' '.join(str(error).split())}") from error
    data: Any = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    root = _root_body(model, path)
    bodies = [body for body in range(model.nbody) if root in (0, int(model.body_rootid[body]))]
    base = np.linalg.inv(pose_of(data.xpos[root], data.xmat[root].reshape(3, 3)))
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    notes = [] if model.ntex == 0 else [f"not read: {model.ntex} texture(s); what has one has the colour of the asset"]
    for geom in range(model.ngeom):
        name = f"geom {model.geom(geom).name or geom!r}"
        shape = _geom(model, geom, base @ pose_of(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)), path, name)
        if shape is None or int(model.geom_bodyid[geom]) not in bodies:
            kind, body = mujoco.mjtGeom(model.geom_type[geom]).name[7:].lower(), model.geom_bodyid[geom]
            notes.append(f"{name}, a {kind} of body {model.body(body).name!r}, is left out")
            continue
        if collides := bool(model.geom_contype[geom] | model.geom_conaffinity[geom]):
            collisions.append(shape)
        if model.geom_group[geom] <= 2 or not collides:  # MuJoCo draws the groups 0 to 2
            visuals.append(shape)
    inertials = []
    for body in (body for body in bodies if model.body_mass[body] > 0):
        pose = base @ pose_of(data.xipos[body], data.ximat[body].reshape(3, 3))
        own = MassProperties(float(model.body_mass[body]), np.zeros(3), np.diag(model.body_inertia[body]))
        inertials.append(moved_inertial(pose, own))
    counts = [(getattr(model, key), what) for key, what in map(str.split, _LEFT_OUT)]
    notes += [f"not read: {count} {what}" for count, what in counts if count]
    if (model.geom_friction[:, 0] != 1.0).any():
        notes.append("not read: friction of geoms, because all objects of a scene have the same")
    free = [j for j in range(model.njnt) if model.jnt_type[j] == 0 and model.jnt_bodyid[j] == root]
    held = [j for j in range(model.njnt) if j not in free and model.jnt_bodyid[j] in bodies]
    if movable := [model.joint(j).name or f"joint {j}" for j in held]:
        notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
    if not free:
        notes.append("it has no free joint: it is welded (`welded: false` makes it free)")
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), None if free else True, tuple(notes))


def _root_body(model: Any, path: Path) -> int:
    """The one body on the world; the world itself where it holds all geoms."""
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if len(roots) > 1:
        names = ", ".join(repr(model.body(body).name) for body in roots)
        raise InvalidInputError(f"{path} holds {len(roots)} bodies ({names}); an asset is one, so put each in a file")
    if not roots and not model.ngeom:
        raise InvalidInputError(f"{path} holds no <body> and no <geom>")
    return roots[0] if roots else 0


def _geom(model: Any, geom: int, pose: Array, path: Path, name: str) -> Shape | None:
    """A geom as MuJoCo takes it: meshes collide as their hulls."""
    kind, material, size = int(model.geom_type[geom]), int(model.geom_matid[geom]), model.geom_size[geom].astype(float)
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    is_textured = material >= 0 and (model.mat_texid[material] >= 0).any()
    color = None if is_textured else _one(np.rint(255.0 * rgba[None]))
    if kind == 7:
        import trimesh

        mesh = model.mesh(int(model.geom_dataid[geom]))
        check_triangles(path, int(mesh.facenum[0]))
        points = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(float)
        faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
        surface = trimesh.Trimesh(points, faces, process=False)
        return Shape("mesh", (1.0, 1.0, 1.0), pose, name, path, color, True, surface=surface)
    sizes: dict[int, tuple[Any, tuple[float, ...]]] = {
        2: ("sphere", (size[0],)), 3: ("capsule", (size[0], 2 * size[1])), 4: ("ellipsoid", tuple(size)),
        5: ("cylinder", (size[0], 2 * size[1])), 6: ("box", tuple(2 * size)),
    }  # fmt: skip
    return Shape(*sizes[kind], pose, name, None, color) if kind in sizes else None


def open_stage(path: Path) -> Any:
    """The stage of a USD file; MissingDependencyError without usd-core, CorruptFileError for what is no USD."""
    try:
        from pxr import Tf, Usd
    except ImportError as error:
        raise MissingDependencyError(f"{path} needs usd-core; `pip install 'scene-envs[export]'`") from error
    check_file(path)
    try:
        stage: Any = Usd.Stage.Open(str(path))
        stage.Reload()  # a layer that this process has open is not read again
    except Tf.ErrorException as error:
        raise CorruptFileError(f"{path} cannot be read as USD: {' '.join(str(error).split())[:300]}") from error
    return stage


def read_usd(path: Path) -> Model:
    """The body in a USD file with UsdPhysics, in the frame of the stage, z up, in metres. Colliders without a rigid
    body are welded; a stage without physics is a mesh. Raises MissingDependencyError without usd-core, CorruptFileError
    for a file that cannot be composed, and InvalidInputError for one that does not state its unit, or holds several
    bodies that no joint connects, or shapes that are sheared.
    """
    stage = open_stage(path)
    from pxr import Usd, UsdGeom, UsdPhysics

    if lost := [" ".join(str(error).split()) for error in stage.GetCompositionErrors()]:
        raise CorruptFileError(f"{path} refers to what cannot be loaded: {lost[0][:300]}")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        raise InvalidInputError(f"{path} does not state `metersPerUnit`; set it, 1 for metres or 0.01 for centimetres")
    reading = _Stage(path, stage)
    prims = [prim for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()) if prim.IsActive()]
    bodies = [prim for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    joints = [UsdPhysics.Joint(prim) for prim in prims if prim.IsA(UsdPhysics.Joint)]
    if len(bodies) > 1 and not joints:
        names = ", ".join(str(prim.GetPath()) for prim in bodies)
        raise InvalidInputError(f"{path} holds {len(bodies)} bodies ({names}); an asset is one, so put each in a file")
    if many := [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.PointInstancer)]:
        raise InvalidInputError(
            f"{path}: {many[0]} is a point instancer, which is not read; make its instances prims"
        )
    for prim in (prim for prim in prims if prim.IsA(UsdGeom.Gprim)):
        reading.add(prim)
    for body in bodies:
        reading.weigh(body)
    notes = list(dict.fromkeys(reading.notes))
    if movable := [j.GetPrim().GetName() for j in joints if not j.GetPrim().IsA(UsdPhysics.FixedJoint)]:
        notes.append(f"movable joints frozen where they are: {', '.join(movable)}")
    held = any(not end.GetTargets() for joint in joints for end in (joint.GetBody0Rel(), joint.GetBody1Rel()))
    why = "it has colliders and no rigid body" if reading.collisions and not bodies else ""
    if why := "a joint holds it at the world" if held else why:
        notes.append(f"{why}: it is welded (`welded: false` makes it free)")
    shapes = tuple(reading.visuals), tuple(shape for _, shape in reading.collisions)
    return Model(*shapes, tuple(reading.inertials), bool(why) or None, tuple(notes))


class _Stage:
    """What was read of the prims of a stage, in metres, kilograms and z up."""

    def __init__(self, path: Path, stage: Any) -> None:
        from pxr import UsdGeom, UsdPhysics

        self.path, self.kilograms = path, UsdPhysics.GetStageKilogramsPerUnit(stage)
        self.unit = UsdGeom.GetStageMetersPerUnit(stage)
        self.axes = self.unit * (Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(3))
        self.notes = [] if stage.HasAuthoredMetadata("upAxis") else ["upAxis is not stated: y is up, as USD says"]
        self.visuals: list[Shape] = []
        self.collisions: list[tuple[Any, Shape]] = []  # with their prims
        self.inertials: list[MassProperties] = []

    def _matrix(self, prim: Any) -> tuple[Array, Array]:
        """(3, 3) and (3,) m that take coordinates of a prim, in its unit, to the model frame."""
        from pxr import UsdGeom

        rows = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
        return self.axes @ rows[:3, :3].T, self.axes @ rows[3, :3]

    def add(self, prim: Any) -> None:
        """Read a shape as a visual, a collider or both."""
        from pxr import UsdGeom, UsdPhysics

        owner = next((p for p in _and_above(prim) if p.HasAPI(UsdPhysics.CollisionAPI)), None)
        collides = owner is not None and UsdPhysics.CollisionAPI(owner).GetCollisionEnabledAttr().Get() is not False
        image = UsdGeom.Imageable(prim)
        drawn = image.ComputePurpose() in ("default", "render") and image.ComputeVisibility() != "invisible"
        shape = self._mesh(prim, owner) if prim.IsA(UsdGeom.Mesh) else self._primitive(prim)
        if shape is None:
            self.notes.append(f"{prim.GetPath()} is a {prim.GetTypeName()}, which is left out")
        else:
            self.collisions += [(prim, shape)] if collides else []
            self.visuals += [shape] if drawn else []

    def _mesh(self, prim: Any, owner: Any) -> Shape:
        """A mesh, a hull where its collider (of ``owner``) is one."""
        import trimesh

        where, colors, (matrix, place) = str(prim.GetPath()), self._colors(prim), self._matrix(prim)
        names = ("points", "faceVertexIndices", "faceVertexCounts")
        found, corners, counts = (np.array(prim.GetAttribute(name).Get() or ()) for name in names)
        corners, counts, points = corners.astype(int), counts.astype(int), found.reshape(-1, 3).astype(float)
        if counts.sum() != len(corners) or not len(corners) or not 0 <= corners.min() <= corners.max() < len(points):
            raise CorruptFileError(f"{self.path}: the faces of {where} do not fit to its points")
        self.notes += [f"{where}: its holes are filled"] if prim.GetAttribute("holeIndices").Get() else []
        cut, polygons = cut_polygons(points, corners, counts)
        check_triangles(self.path, len(cut))
        inside_out = (prim.GetAttribute("orientation").Get() == "leftHanded") != (np.linalg.det(matrix) < 0)
        faces = corners[cut][:, :: -1 if inside_out else 1]
        surface: Any = trimesh.Trimesh(points @ matrix.T + place, faces, process=False)
        if len(colors) == len(counts):
            surface.visual.face_colors = colors[polygons]
        elif len(colors) == len(points):
            surface.visual.vertex_colors = colors
        else:
            self.notes += [f"{where}: its {len(colors)} colours are not read"] if len(colors) > 1 else []
        how = owner.GetAttribute("physics:approximation").Get() if owner else None
        is_hull = how in ("convexHull", "boundingCube", "boundingSphere")
        self.notes += [f"{where}: its {how} is taken as its hull"] if is_hull and how != "convexHull" else []
        return Shape("mesh", (1.0,) * 3, np.eye(4), where, self.path, _one(colors), is_hull, surface=surface)

    def _primitive(self, prim: Any) -> Shape | None:
        where, color, (matrix, place) = str(prim.GetPath()), _one(self._colors(prim)), self._matrix(prim)
        kind, scales = prim.GetTypeName(), np.linalg.norm(matrix, axis=0)
        turn = matrix / scales * np.sign(np.linalg.det(matrix))  # primitives look the same in a mirror
        if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-6:
            raise InvalidInputError(f"{self.path}: {where} is sheared; make it a mesh")
        if kind == "Cube":
            return Shape("box", tuple(_number(prim, "size") * scales), pose_of(place, turn), where, None, color)
        if kind == "Sphere":
            return Shape("ellipsoid", tuple(_number(prim, "radius") * scales), pose_of(place, turn), where, None, color)
        if kind not in ("Cylinder", "Capsule"):
            return None
        order = np.roll(np.arange(3), -"XYZ".index(prim.GetAttribute("axis").Get()) - 1)  # the axis last
        scales, pose = scales[order], pose_of(place, turn[:, order])
        if np.ptp(scales[: 2 if kind == "Cylinder" else 3]) > 1e-6 * scales.max():
            raise InvalidInputError(f"{self.path}: {where} is scaled unevenly; make it a mesh")
        size = (float(_number(prim, "radius") * scales[0]), float(_number(prim, "height") * scales[2]))
        return Shape("cylinder" if kind == "Cylinder" else "capsule", size, pose, where, None, color)

    def _colors(self, prim: Any) -> Any:
        """(N, 3) in 0..255 from the linear colours of a prim, N 0 without any."""
        from pxr import UsdGeom, UsdShade

        values = UsdGeom.Gprim(prim).GetDisplayColorAttr().Get() or ()
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        for shader in material.GetPrim().GetChildren() if material else ():
            diffuse = shader.GetAttribute("inputs:diffuseColor")
            if diffuse and diffuse.HasAuthoredValue() and not diffuse.HasAuthoredConnections():
                values = [diffuse.Get()]
            if shader.GetAttribute("inputs:file"):
                self.notes.append(f"not read: the textures of {material.GetPath()}")
        rubs = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        if _number(rubs, "physics:dynamicFriction") or _number(rubs, "physics:staticFriction"):
            self.notes.append("not read: friction of materials, because all objects of a scene have the same")
        linear = np.clip(np.array(values, dtype=float).reshape(-1, 3), 0.0, 1.0)
        shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.rint(255.0 * shown).astype(np.uint8)

    def weigh(self, body: Any) -> None:
        """Mass properties of a body by the rules of UsdPhysics: its own, else those of its colliders."""
        from pxr import UsdPhysics, UsdShade

        matrix, place = self._matrix(body)
        names = ("mass", "centerOfMass", "diagonalInertia", "principalAxes")
        mass, center, moments, axes = (body.GetAttribute(f"physics:{name}").Get() for name in names)
        has_center, has_moments = center is not None and np.isfinite(center).all(), moments is not None and any(moments)
        nearest = [next((p for p in _and_above(q) if p.HasAPI(UsdPhysics.RigidBodyAPI)), q) for q, _ in self.collisions]
        own = [found for found, owner in zip(self.collisions, nearest, strict=True) if owner == body]
        found = MassProperties((mass or 0.0) * self.kilograms, place, np.zeros((3, 3)))
        if own and not (mass and has_center and has_moments):
            solids = []
            for prim, shape in own:
                solid, weight = solid_of(shape), _number(prim, "physics:mass") * self.kilograms
                material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
                density = next(filter(None, (_number(p, "physics:density") for p in (prim, body, material))), 0.0)
                density *= self.kilograms / self.unit**3
                solids.append(heavier(solid, weight / solid.mass if weight else density or 1000.0))
            filled = merged_inertial(solids)
            found = heavier(filled, (found.mass or filled.mass) / filled.mass)
        if has_center:
            found = found._replace(center_of_mass=matrix @ np.array(center) + place)
        if has_moments:
            quaternion = [*axes.GetImaginary(), axes.GetReal()] if axes and axes.GetLength() else [0.0, 0.0, 0.0, 1.0]
            turn = matrix / np.linalg.norm(matrix, axis=0) @ Rotation.from_quat(quaternion).as_matrix()
            found = found._replace(inertia=(turn * np.array(moments) * self.kilograms * self.unit**2) @ turn.T)
        self.inertials.append(found)


def _one(colors: Any) -> Color | None:
    """The colour of one surface, if it has one."""
    return (int(colors[0, 0]), int(colors[0, 1]), int(colors[0, 2])) if len(colors) == 1 else None


def _number(prim: Any, name: str) -> float:
    """A number of a prim; 0 where it has none."""
    return float((prim.GetAttribute(name).Get() if prim and prim.HasAttribute(name) else None) or 0.0)


def _and_above(prim: Any) -> list[Any]:
    """The prim and those above it."""
    return [] if prim.IsPseudoRoot() else [prim, *_and_above(prim.GetParent())]
