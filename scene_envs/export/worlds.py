"""Worlds for batched simulation: one MuJoCo model of all scenes, and an array file in which each world is a scene.

The body of a column holds one object of each scene, or none: the array file says which, by the fields of MuJoCo's model
that differ. :func:`write_worlds` lists them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import cycle, zip_longest
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset
from scene_envs.errors import InvalidInputError
from scene_envs.export.mjcf import diffuse, new_model
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, camera_axes, quaternion
from scene_envs.export.urdf import write_xml
from scene_envs.files import replacing
from scene_envs.physics.parts import principal_inertia

_NONE = 1e-9
"""Mass (kg), moments of inertia (kg m^2) and size (m) where there is no object; a size of 0 is that of a plane."""
_APART = 50
"""Distance of the bodies, m, in the model without the arrays."""
_UNTURNED = (1.0, 0.0, 0.0, 0.0)
_MOST = 1 << 28
"""Geometries of all worlds together above which the arrays do not fit into the memory of a GPU."""


@dataclass(frozen=True, eq=False)
class _Column:
    """A body of the model, and the object of each scene that it holds."""

    name: str
    welded: bool
    parts: int  # places for convex parts
    objects: Sequence[PlacedObject | None]


def write_worlds(scenes: Sequence[PlacedScene], files: AssetFiles, folder: Path) -> Path:
    """``worlds.xml``, the model, and ``worlds.npz``, which ``numpy.load`` alone can read; returns the second.

    Of W scenes, the model has B bodies, world included, G geometries, F bodies for welded objects and S for free ones.
    Welded objects are mocap bodies ``welded_0`` …; free ones are ``object_0`` … with a free joint of that name. The
    frame of a body is that of its asset. In each scene, objects are sorted by their number of convex parts, then by
    category and slot. A body without an object has no geometry and no weight, and stays at the origin.

    Arrays ``world/FIELD`` (W, ...) are fields of MuJoCo's model, a row for each world: ``geom_dataid`` (W, G), mesh of
    each geometry, -1 for none; ``geom_friction`` (W, G, 3); ``body_pos`` (W, B, 3) m and ``body_quat`` (W, B, 4), where
    objects stand; ``body_mass``, ``body_subtreemass``, ``body_gravcomp`` (W, B), ``body_inertia``, ``body_ipos``
    (W, B, 3), ``body_iquat`` (W, B, 4), ``body_invweight0`` (W, B, 2); ``dof_invweight0`` (W, 6 S); ``qpos0`` (W, 7 S);
    ``mat_texid`` (W, B - 1, 10) and ``mat_rgba`` (W, B - 1, 4), texture and colour of each body; for lamp and camera
    ``light_dir``, ``light_diffuse``, ``cam_pos`` (W, 1, 3), ``cam_quat`` (W, 1, 4), ``cam_fovy`` (W, 1) degrees.
    Arrays ``mesh/FIELD`` (M + 1, ...) have a row for each mesh and a last one for none, so that indexing them with
    ``geom_dataid`` gives the field: ``geom_pos``, ``geom_quat``, ``geom_size``, ``geom_rbound`` and ``geom_aabb``. For
    bodies without the world: ``names`` (W, B - 1) text as in other formats, ``categories`` and ``slots`` (W, B - 1)
    int64, -1 for none. ``asset_names`` (C,) and ``scene_type`` are text.

    Raises:
        InvalidInputError: there is no scene, or no object, or together the worlds have too many geometries.
    """
    columns = [*_columns(scenes, welded=True), *_columns(scenes, welded=False)]
    if not columns:
        raise InvalidInputError(
            f"worlds of {len(scenes)} scenes without objects: give at least one scene with an object"
        )
    count = len(scenes) * sum(1 + column.parts for column in columns)
    if count > _MOST:
        raise InvalidInputError(f"{len(scenes)} worlds have {count} geometries, more than {_MOST}: export fewer scenes")
    used = {item.category: item.asset for scene in scenes for item in scene.objects}
    assets = [used[category] for category in sorted(used)]
    # MuJoCo makes hulls of the meshes that geometries which collide have in the model: each has a place in it
    left = sum(len(asset.fine) for asset in assets) - sum(column.parts for column in columns)
    columns[-1] = replace(columns[-1], parts=columns[-1].parts + max(0, left))
    path = write_xml(_model(scenes[0], columns, assets, files, folder), folder / "worlds.xml")
    arrays = _arrays(columns, _meshes(path), files) | _views(scenes)
    arrays["asset_names"] = np.array(scenes[0].scene_type.assets, dtype=str)
    arrays["scene_type"] = np.array(scenes[0].scene_type.name)
    with replacing(path.with_suffix(".npz")) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return path.with_suffix(".npz")


def _columns(scenes: Sequence[PlacedScene], *, welded: bool) -> list[_Column]:
    """Columns of the welded or of the free objects, those of many parts first."""
    rows = [[item for item in scene.objects if item.welded is welded] for scene in scenes]
    ranked = [sorted(row, key=lambda item: (-len(item.asset.fine), item.category)) for row in rows]
    kind = "welded" if welded else "object"
    columns = list(zip_longest(*ranked))
    most = [max(len(item.asset.fine) for item in objects if item is not None) for objects in columns]
    return [_Column(f"{kind}_{rank}", welded, *column) for rank, column in enumerate(zip(most, columns, strict=True))]


def _model(
    scene: PlacedScene, columns: Sequence[_Column], assets: Sequence[Asset], files: AssetFiles, folder: Path
) -> ET.Element:
    """The model: a body and a material for each column, with geometries for the picture and the most parts of its
    objects.
    """
    objects = [item for column in columns for item in column.objects if item is not None]
    root, world = new_model(f"{scene.scene_type.name}_worlds", scene, objects, files, folder)
    shared = root[3]
    first = shared.findall("material")[0].attrib["name"]
    for material in shared.findall("material"):
        shared.remove(material)
    parts = cycle(f"{files.name(asset)}_{part.stem}" for asset in assets for part in files.parts(asset))
    reach = np.linalg.norm(np.subtract(scene.camera.position, scene.camera.target))
    ET.SubElement(root, "statistic", extent=f"{reach:g}")  # from which renderers take what is too near to be seen
    for index, column in enumerate(columns):  # far from each other: as compiled, no two bodies touch
        place = f"{_APART * index} 0 {_APART}"
        body = ET.SubElement(world, "body", {"name": column.name, "pos": place, "gravcomp": "1"})
        if column.welded:
            body.set("mocap", "true")
        else:
            ET.SubElement(body, "freejoint", name=column.name)
            # another frame than the body's: MuJoCo must not compile in that both are the same
            inertial = {"pos": "0.1 0.2 0.3", "quat": "0.5 0.1 0.3 0.7"}
            ET.SubElement(body, "inertial", {**inertial, "mass": "1", "diaginertia": "1 1 1"})
        ET.SubElement(shared, "material", name=column.name, texture=first, specular="0.2")
        ET.SubElement(body, "geom", {"class": "visual", "mesh": f"{first}_visual", "material": column.name})
        for _ in range(column.parts):
            ET.SubElement(body, "geom", {"class": "collision", "mesh": next(parts)})
    return root


def _meshes(path: Path) -> tuple[dict[str, int], dict[str, Array]]:
    """Number of each mesh and texture of a model, and ``mesh/FIELD`` arrays. MuJoCo recentres and turns meshes when it
    compiles them; a body that has each mesh once, where its file puts it, shows how.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    names = [mesh.name for mesh in spec.meshes]
    probe = spec.worldbody.add_body()
    for name in names:
        probe.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
    model = spec.compile()
    last: list[tuple[str, Any]] = [("pos", 0.0), ("quat", _UNTURNED), ("size", _NONE), ("rbound", _NONE)]
    rows = {name: (getattr(model, f"geom_{name}")[-len(names) :], empty) for name, empty in last}
    rows["aabb"] = model.geom_aabb[-len(names) :], (0.0, 0, 0, _NONE, _NONE, _NONE)
    numbers = {name: int(model.mesh(name).id) for name in names}
    order = np.argsort([numbers[name] for name in names])
    textures = {
        f"{texture.name}.image": int(model.texture(texture.name).id) for texture in spec.textures if texture.name
    }
    return numbers | textures, {
        f"mesh/geom_{name}": np.concatenate([values[order], np.broadcast_to(empty, (1, *values.shape[1:]))])
        for name, (values, empty) in rows.items()
    }


def _arrays(columns: Sequence[_Column], meshes: tuple[dict[str, int], dict[str, Array]], files: AssetFiles) -> Any:
    """All arrays of the worlds."""
    number, arrays = meshes
    worlds, bodies, fixed = len(columns[0].objects), 1 + len(columns), sum(column.welded for column in columns)
    first = np.cumsum([0, *(1 + column.parts for column in columns)])
    placed = [
        (world, body, item)
        for body, column in enumerate(columns, start=1)
        for world, item in enumerate(column.objects)
        if item is not None
    ]
    free = [row for row in placed if not row[2].welded]

    def table(rows: Sequence[tuple[int, int, PlacedObject]], values: Any, empty: Any) -> Any:
        """(W, B, ...) of the values of the objects ``rows``; the others are ``empty``."""
        values = np.asarray(values)
        out = np.empty((worlds, bodies, *values.shape[1:]), dtype=values.dtype)
        out[:] = empty
        out[[world for world, _, _ in rows], [body for _, body, _ in rows]] = values
        return out

    shapes: dict[str, list[int]] = {}
    dataid = np.full((worlds, first[-1]), -1, dtype=np.int32)
    for world, body, item in placed:
        if (look := files.look(item)) not in shapes:
            names = [f"{files.name(item.asset)}_{part.stem}" for part in files.parts(item.asset)]
            shapes[look] = [number[f"{look}_visual"], *(number[name] for name in names)]
        dataid[world, first[body - 1] : first[body - 1] + len(shapes[look])] = shapes[look]
    textures = np.full((len(placed), 10), -1, dtype=np.int32)
    textures[:, 1] = [number[f"{files.look(item)}.image"] for _, _, item in placed]
    position = table(placed, [item.translation for _, _, item in placed], 0.0)
    turn = table(placed, quaternion(np.stack([item.rotation for _, _, item in placed])), _UNTURNED)
    friction = table(placed, [item.friction for _, _, item in placed], files.friction)[:, 1:].repeat(
        np.diff(first), axis=1
    )
    mass = np.array([item.mass for _, _, item in free])
    center = np.array([item.asset.center_of_mass for _, _, item in free]).reshape(-1, 3)
    moments, axes = principal_inertia(np.array([item.inertia for _, _, item in free]).reshape(-1, 3, 3))
    weight = np.stack([1.0 / mass, (1.0 / moments).mean(axis=1)], axis=1)
    # a push at the origin of the body turns it as well: the mean over directions is tr([c]^T I^-1 [c]) / 3
    arm = np.cross(center[:, None], axes.swapaxes(1, 2))
    push = weight[:, 0] + ((arm * arm).sum(axis=2) / moments).sum(axis=1) / 3.0
    none = np.where(np.arange(bodies) > fixed, _NONE, 0.0)
    rare = np.where(np.arange(bodies) > fixed, 1.0 / _NONE, 0.0)[:, None]
    fields = {
        "geom_dataid": dataid,
        "mat_texid": table(placed, textures, -1)[:, 1:],
        "mat_rgba": table(placed, [(*item.color, 1.0) for _, _, item in placed], 1.0)[:, 1:].astype(np.float32),
        "geom_friction": np.stack([friction, *(np.full_like(friction, value) for value in (0.005, 0.0001))], axis=2),
        "body_pos": position,
        "body_quat": turn,
        "body_mass": table(free, mass, none),
        "body_inertia": table(free, moments, none[:, None]),
        "body_ipos": table(free, center, 0.0),
        "body_iquat": table(free, quaternion(axes), _UNTURNED),
        "body_invweight0": table(free, weight, rare),
        "body_gravcomp": table(placed, np.zeros(len(placed)), none > 0),
        "dof_invweight0": table(free, np.repeat(np.stack([push, weight[:, 1]], 1), 3, 1), rare)[:, 1 + fixed :],
        "qpos0": np.concatenate([position, turn], axis=2)[:, 1 + fixed :],
    }
    subtree = fields["body_subtreemass"] = fields["body_mass"].copy()
    subtree[:, 0] = subtree.sum(axis=1)
    for name in ("dof_invweight0", "qpos0"):
        fields[name] = fields[name].reshape(worlds, -1)
    arrays |= {f"world/{name}": values for name, values in fields.items()}
    arrays["names"] = table(placed, [item.name for _, _, item in placed], "")[:, 1:]
    arrays["categories"] = table(placed, [item.category for _, _, item in placed], -1)[:, 1:]
    arrays["slots"] = table(placed, [item.slot for _, _, item in placed], -1)[:, 1:]
    return arrays


def _views(scenes: Sequence[PlacedScene]) -> dict[str, Array]:
    """Light and camera of each world."""
    cameras, lights = [scene.camera for scene in scenes], [scene.light for scene in scenes]
    turns = np.stack([camera_axes(camera.position, camera.target, camera.up) for camera in cameras])
    fields = {
        "light_dir": [[light.direction] for light in lights],
        "light_diffuse": np.array([[diffuse(light)] for light in lights], dtype=np.float32),
        "cam_pos": [[camera.position] for camera in cameras],
        "cam_quat": quaternion(turns)[:, None],
        "cam_fovy": [[camera.fov_y] for camera in cameras],
    }
    return {f"world/{name}": np.asarray(values) for name, values in fields.items()}
