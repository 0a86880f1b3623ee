"""Stage, cameras and lighting: what is seen of a library's meshes, from where, and with which shadows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index
from scene_envs.assets import Asset, get_library
from scene_envs.assets.shapes import winding_number
from scene_envs.errors import InvalidInputError
from scene_envs.render.raster import Pinhole, visible_triangles
from scene_envs.scene_types import Camera, FixedObject, SceneType, get_scene_type

_AMBIENT, _DIFFUSE = 0.70, 0.40
"""Light from everywhere, and light of the lamp on a surface that faces it."""
_SIDES = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_TOP = np.array([0.0, 0.0, 1.0])
_RAYS = 24
_FOV = 28.0
_MARGIN = 0.05
_LAMP_PIXELS = 512, 1024
"""Resolution of the lamp's depth image for framings of a radius up to 2 m, and for larger ones."""
_TURNS = (np.arange(12) + 0.5) * np.pi * (3.0 - np.sqrt(5.0))
_RADII = np.sqrt((np.arange(12) + 0.5) / 12)
_SPIRAL = np.stack([_RADII * np.cos(_TURNS), _RADII * np.sin(_TURNS)], axis=1).astype(np.float32)
"""(12, 2) points spread evenly over the unit disc (sunflower), at which shadows and contact shades are sampled."""
_SOFTNESS = 1.8
"""Radius of the filter of shadows, pixels of the lamp's image."""
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Frame:
    """What a camera sees in each pixel."""

    depth: NDArray[np.float32]  # (H, W) float32, distance along the viewing direction, m; inf without an object
    slots: NDArray[np.int64]  # (H, W) int64, slot of the visible object; -1 without one
    faces: NDArray[np.int64]  # (H, W) int64, visible triangle among those of the stage; -1 without one
    camera: Pinhole


class Stage:
    """The visual meshes of the assets ``names``, in category order; pictures place copies of them."""

    def __init__(self, names: tuple[str, ...], folders: tuple[str, ...] = ()) -> None:
        self._library = get_library(names, folders)
        self.place(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, dtype=np.int64))

    def place(self, translations: Array, rotations: Array, categories: Index) -> None:
        """Put up the objects of one scene, and nothing else.

        Poses are translations (N, 3) m and rotations (N, 3, 3). Slots whose category (N,) is outside the library are
        empty.
        """
        self._lamps: dict[SceneType, Frame] = {}
        # In an order that does not depend on slots, which decides between surfaces at the same place
        order = np.lexsort((*translations.T, categories))
        slots = [slot for slot in order.tolist() if 0 <= categories[slot] < len(self._library)]
        models = [_model(self._library[int(categories[slot])]) for slot in slots]
        starts = np.cumsum([0, *(len(model.vertices) for model in models)])
        placed = [(model, rotations[slot].T, translations[slot]) for slot, model in zip(slots, models, strict=True)]
        none = np.empty((0, 3))
        self._vertices = np.concatenate([none, *(model.vertices @ turn + shift for model, turn, shift in placed)])
        self._normals = np.concatenate([none, *(model.normals @ turn for model, turn, _ in placed)])
        self._colors = np.concatenate([none, *(model.colors for model in models)])
        faces = (model.faces + start for model, start in zip(models, starts, strict=False))
        self._faces = np.concatenate([none.astype(np.int64), *faces])
        self._slots, self._starts = slots, starts[:-1]
        # (F,): the slot of each triangle
        self.slot_of = np.repeat(np.array(slots, dtype=np.int64), [len(model.faces) for model in models])

    def lamp(self, scene_type: SceneType) -> Frame:
        """What the lamp of the type's pictures sees of the placed objects; the same for all cameras."""
        if scene_type not in self._lamps:
            self._lamps[scene_type] = self.look(light_camera(scene_type))
        return self._lamps[scene_type]

    def look(self, camera: Pinhole) -> Frame:
        """What ``camera`` sees of the placed objects."""
        faces, depth = visible_triangles(self._points(camera), self._faces, camera)
        return Frame(depth, np.append(self.slot_of, -1)[faces], faces, camera)

    def enclosing_slot(self, point: Array) -> int:
        """Slot of an object whose visual mesh encloses ``point`` (3,), m; -1 without one."""
        if not self._slots:
            return -1
        low, high = (limit.reduceat(self._vertices, self._starts) for limit in (np.minimum, np.maximum))
        for index in np.flatnonzero(((low < point) & (point < high)).all(axis=1)).tolist():
            triangles = self._vertices[self._faces[self.slot_of == self._slots[index]]]
            if abs(winding_number(triangles, point)) > 0.5:
                return self._slots[index]
        return -1

    def normals(self, camera: Pinhole) -> Image:
        """(F + 1, 3) float32: unit normals of all triangles, camera frame, on the side that ``camera`` sees; the last
        one is 0 and stands for no triangle.
        """
        corners = self._points(camera)[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        away = np.einsum("fk,fk->f", normals, corners[:, 0]) > 0.0
        return np.concatenate([np.where(away[:, None], -normals, normals), np.zeros((1, 3))]).astype(np.float32)

    def paint(self, camera: Pinhole, faces: Index, points: Image, normals: Image, to_light: Array) -> Image:
        """(P, 3) float32 in 0..255: colours of the points (P, 3) of triangles ``faces`` (P,), camera frame in m, lit
        from the direction ``to_light`` (3,) of the world without shadows. ``normals`` are those of :meth:`normals`.
        """
        seen = np.zeros(len(self._faces), dtype=bool)
        seen[faces] = True
        (used,), at = np.nonzero(seen), (np.cumsum(seen) - 1)[faces]
        corners = self._points(camera)[self._faces[used]]
        # The weights of the second and the third corner of a triangle a, b, c are p . (c x a) and p . (a x b), divided
        # by a . (b x c), in a point p of it.
        across = np.cross(corners[:, [2, 0]], corners[:, [0, 1]])
        volume = np.einsum("fk,fk->f", corners[:, 2], across[:, 1])[:, None, None]
        across = across / np.where(volume == 0.0, 1.0, volume)
        # Light falls on the side of a surface that the camera sees, whichever way its normals point.
        own = self._normals[self._faces[used]]
        side = np.sign(np.einsum("fjk,fk->fj", own @ camera.view[:3, :3].T, normals[used]))
        towards = np.maximum(side * (own @ (to_light / np.linalg.norm(to_light))), 0.0)
        lit = self._colors[self._faces[used]] * (_AMBIENT + _DIFFUSE * towards[..., None])
        lit[:, 1:] -= lit[:, :1]
        table = np.concatenate([across.reshape(-1, 6), lit.reshape(-1, 9)], axis=1).astype(np.float32)[at]
        second = np.clip(np.einsum("pk,pk->p", table[:, 0:3], points), 0.0, 1.0)[:, None]
        third = np.clip(np.einsum("pk,pk->p", table[:, 3:6], points), 0.0, 1.0)[:, None]
        return np.minimum(table[:, 6:9] + second * table[:, 9:12] + third * table[:, 12:15], 255.0)

    def _points(self, camera: Pinhole) -> Array:
        view = camera.view
        return self._vertices @ view[:3, :3].T + view[:3, 3]


class _Model(NamedTuple):
    vertices: Array  # (V, 3), m
    normals: Array  # (V, 3), unit vectors
    colors: Array  # (V, 3), 0..255
    faces: Index  # (F, 3)


@cache
def _model(asset: Asset) -> _Model:
    mesh = asset.visual
    columns = mesh.vertices, mesh.vertex_normals, vertex_colors(asset)
    vertices, normals, colors = (np.array(column, dtype=np.float64) for column in columns)
    return _Model(vertices, normals, colors, np.array(mesh.faces, dtype=np.int64))


get_stage = cache(Stage)
"""The stage of this process for asset names in category order, which are looked up in the given folders first."""


def vertex_colors(asset: Asset) -> NDArray[np.uint8]:
    """(V, 3): the colour of each vertex of the visual mesh; the class colour where the mesh has none."""
    visual: Any = asset.visual.visual
    if getattr(visual, "kind", None) == "texture":
        visual = visual.to_color()
    if getattr(visual, "kind", None) is None:
        return np.tile(np.array(asset.color, dtype=np.uint8), (len(asset.visual.vertices), 1))
    return np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Framing:
    """Points to show, with the directions of camera and lamp."""

    points: Array  # (P, 3) points that the picture shows, world frame, m
    to_camera: Array  # (3,) unit vector from the scene towards the camera
    to_light: Array  # (3,) unit vector from the scene towards the lamp
    ground: float  # lowest z of all supports, m

    @property
    def center(self) -> Array:
        """(3,) middle of the bounding box of the points, m."""
        return 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))

    @property
    def radius(self) -> float:
        """Largest distance (m) of a point from the centre."""
        return float(np.linalg.norm(self.points - self.center, axis=1).max())


@lru_cache(maxsize=64)
def frame_scene_type(scene_type: SceneType) -> Framing:
    """Framing of scenes of this type.

    A support that rises through the workspace (a shelf) is seen whole, from its open side and slightly above; one that
    is open above (a bin) steeply from above. On a table or floor, or without support, the view is a three-quarter view
    from above, across the longer side, steeper for flatter workspaces.
    """
    low, high = (np.array(corner) for corner in scene_type.workspace)
    extent = high - low
    boxes, vertices = _fixed_geometry(scene_type)
    ground = float(min(low[2], vertices[:, 2].min(initial=np.inf)))
    if vertices[:, 2].max(initial=-np.inf) > low[2] + 0.25 * extent[2]:
        side = _open_side(boxes)
        top = vertices[:, 2].max()
        above = _footprint(low, high, 1.0, max(top, high[2]))
        points = np.concatenate([vertices, above])
        if side is None:
            return Framing(points, _direction(_across(extent), 52.0), _direction(_across(extent) - 85.0, 62.0), ground)
        facing = float(np.degrees(np.arctan2(side[1], side[0])))
        return Framing(points, _direction(facing - 30.0, 15.0), _direction(facing + 12.0, 30.0), ground)
    flatness = float(np.clip(2.0 - extent[2] / (0.18 * extent[:2].max()), 0.0, 1.0))  # 0: a table, 1: a room
    azimuth, elevation = _across(extent) * (1.0 - flatness) - 24.0 * flatness, 37.0 + 10.0 * flatness
    upper = vertices[vertices[:, 2] >= low[2] - 0.05 * extent[:2].max()]
    height = min(0.6 * extent[:2].min(), 0.75 * extent[2])
    filled = _footprint(low, high, 0.7, low[2] + height)
    base = upper if len(upper) else _footprint(low, high, 1.0, low[2])
    points = np.concatenate([base, filled])
    return Framing(points, _direction(azimuth, elevation), _direction(azimuth - 85.0, 57.0), ground)


def scene_type_of_one(scene_type: SceneType, translations: Array, rotations: Array, categories: Index) -> SceneType:
    """Scene type for the framing of one scene, in which its only welded object, if it has one, counts as fixed there.

    A union of scene types has no fixed objects and the workspace of the largest type, in which a table would be tiny.
    Poses are (N, 3) m and (N, 3, 3); empty slots have the number of assets as category (N,).
    """
    names = np.array([*scene_type.assets, ""])[categories]
    supports = np.flatnonzero(np.isin(names, scene_type.welded))
    if scene_type.fixed or len(supports) != 1:
        return scene_type

    def fixed(slots: Index) -> SceneType:
        poses = ((translations[slot].tolist(), rotations[slot].ravel().tolist()) for slot in slots)
        objects = (FixedObject(str(names[slot]), *map(tuple, pose)) for slot, pose in zip(slots, poses, strict=True))
        return replace(scene_type, fixed=tuple(objects))

    support = fixed(supports)
    vertices = _fixed_geometry(support)[1]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    lost = np.abs(translations - 0.5 * (low + high)).max(axis=1) > (high - low).max()
    objects = np.flatnonzero((names != "") & (np.arange(len(names)) != supports[0]) & ~lost)
    low[2] = translations[objects, 2].min(initial=high[2])
    tops = _fixed_geometry(fixed(objects))[1][:, 2]
    high[2] = max(high[2], tops.max(initial=-np.inf), low[2] + 0.1 * (high - low)[:2].max())
    return replace(support, workspace=(tuple(low.tolist()), tuple(high.tolist())))


def fit_camera(points: Array, to_camera: Array, fov_y: float, aspect: float, margin: float) -> tuple[Array, Array]:
    """Position and target (m) of the nearest camera without roll that sees all points (P, 3) m. ``to_camera`` (3,) is a
    unit vector from the scene, not vertical; ``fov_y`` the vertical field of view in degrees; ``aspect`` width to
    height; ``margin`` the share of the half image that stays free at each border.
    """
    right = np.cross(_TOP, to_camera)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(to_camera, right), to_camera])
    seen = points @ axes.T  # (P, 3): right, up, towards the camera
    slope = np.tan(np.radians(fov_y) / 2.0) * (1.0 - margin) * np.array([aspect, 1.0])
    # A camera at (x, y, d) sees a point when |x_p - x| <= slope_x (d - d_p), and the same for y.
    upper = (seen[:, :2] + slope * seen[:, 2:]).max(axis=0)
    lower = (-seen[:, :2] + slope * seen[:, 2:]).max(axis=0)
    distance = float(((upper + lower) / (2.0 * slope)).max())
    place = np.array([*(0.5 * (upper - lower)), distance])
    target = np.array([place[0], place[1], 0.5 * (seen[:, 2].min() + seen[:, 2].max())])
    return place @ axes, target @ axes


def _fixed_geometry(scene_type: SceneType) -> tuple[Array, Array]:
    """World boxes (P, 2, 3) around the parts of fixed objects, and all corners (V, 3) of those parts, m."""
    boxes, vertices = [np.empty((0, 2, 3))], [np.empty((0, 3))]
    for fixed in scene_type.fixed:
        rotation = np.reshape(fixed.rotation, (3, 3))
        for part in scene_type.library[fixed.asset].fine:
            corners = part.vertices @ rotation.T + np.array(fixed.translation)
            vertices.append(corners)
            boxes.append(np.stack([corners.min(axis=0), corners.max(axis=0)])[None])
    return np.concatenate(boxes), np.concatenate(vertices)


def _open_side(boxes: Array) -> Array | None:
    """The horizontal direction with the clearest view; None if the view from straight above is as clear."""
    covered = [_covered(boxes, side) for side in _SIDES]
    return None if _covered(boxes, _TOP) <= min(covered) else _SIDES[int(np.argmin(covered))]


def _covered(boxes: Array, side: Array) -> float:
    """Part of the view from ``side`` that boxes block before two thirds of the depth."""
    axis = int(np.argmax(np.abs(side)))
    across: Sequence[int] = [a for a in range(3) if a != axis]
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    depth = np.sort(boxes[:, :, axis] * side[axis], axis=1)
    reach = max(low[axis] * side[axis], high[axis] * side[axis]) - (2.0 / 3.0) * (high[axis] - low[axis])
    steps = (np.arange(_RAYS) + 0.5) / _RAYS
    u, v = (low[a] + steps * (high[a] - low[a]) for a in across)
    in_u, in_v = (
        (boxes[:, 0, a, None] <= w) & (w <= boxes[:, 1, a, None]) & (depth[:, 1:] > reach)
        for a, w in zip(across, (u, v), strict=True)
    )
    return float((in_u[:, :, None] & in_v[:, None, :]).any(axis=0).mean())


def _footprint(low: Array, high: Array, share: float, z: float) -> Array:
    """(4, 3): corners of the middle ``share`` of the workspace's footprint at height ``z``, m."""
    center, half = 0.5 * (low + high), 0.5 * share * (high - low)
    return np.array([[center[0] + i * half[0], center[1] + j * half[1], z] for i in (-1, 1) for j in (-1, 1)])


def _across(extent: Array) -> float:
    """Azimuth (degrees) of a camera that has the longer side of the workspace across its picture."""
    return -28.0 if extent[1] > 1.25 * extent[0] else -62.0


def _direction(azimuth: float, elevation: float) -> Array:
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def picture_camera(scene_type: str | SceneType, width: int = 480, height: int = 360) -> Camera:
    """The three-quarter view of pictures without a given camera.

    It is derived from the workspace and the fixed objects (see
    :func:`~scene_envs.render.stage.frame_scene_type`), so it also suits users' scene types.

    The size of the image, ``width`` by ``height`` pixels, determines the distance of the camera.

    >>> camera = picture_camera("dimsum_table", 640, 480)
    >>> camera.width, camera.fov_y
    (640, 28.0)
    """
    if width < 1 or height < 1:
        raise InvalidInputError(f"an image needs at least 1 x 1 pixels, got width={width}, height={height}")
    framing = frame_scene_type(get_scene_type(scene_type))
    position, target = fit_camera(framing.points, framing.to_camera, _FOV, width / height, _MARGIN)
    return Camera(_triple(position), _triple(target), (0.0, 0.0, 1.0), width, height, _FOV)


def light_camera(scene_type: SceneType) -> Pinhole:
    """The view from a far lamp that sees the whole workspace."""
    framing = frame_scene_type(scene_type)
    position = framing.center + 8.0 * framing.radius * framing.to_light
    fov, pixels = 2.0 * float(np.degrees(np.arctan(1.1 / 8.0))), _LAMP_PIXELS[framing.radius > 2.0]
    return Pinhole.at(_triple(position), _triple(framing.center), (0.0, 1.0, 0.0), fov, pixels, pixels)


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def to_pinhole(camera: Camera | Pinhole, width: int | None = None, height: int | None = None) -> Pinhole:
    """The pinhole camera of any camera, with images of another size where one is given."""
    width, height = camera.width if width is None else width, camera.height if height is None else height
    if width < 1 or height < 1:
        raise InvalidInputError(f"width={width}, height={height}: an image has at least one pixel each way")
    if isinstance(camera, Pinhole):
        return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
    return Pinhole.at(camera.position, camera.target, camera.up, camera.fov_y, width, height)


def soft_shadow(points: Image, camera: Pinhole, light: Frame, bias: float) -> NDArray[np.float32]:
    """(P,) in 0..1: the part of the light that nearer objects hide from points (P, 3), in the frame of ``camera``, by
    percentage-closer filtering in ``light``, the frame seen from the light. An occluder is nearer to it than the point
    by at least ``bias`` (m).
    """
    to_light = (light.camera.view @ camera.pose).astype(np.float32)
    points = points @ to_light[:3, :3].T + to_light[:3, 3]
    distance = np.maximum(points[:, 2], np.float32(1e-3))  # objects may lie behind the lamp
    height, width = light.depth.shape
    column = points[:, 0] / distance * np.float32(light.camera.fx) + np.float32(light.camera.cx)
    row = points[:, 1] / distance * np.float32(light.camera.fy) + np.float32(light.camera.cy)
    limit = distance - np.float32(bias)
    nearest = light.depth.ravel()
    hidden = np.zeros(len(points), dtype=np.float32)
    for dx, dy in _SPIRAL * _SOFTNESS:
        index = _pixel(row + dy, height) * width + _pixel(column + dx, width)
        hidden += nearest[index] < limit
    return hidden / np.float32(len(_SPIRAL))


def contact_shade(points: Image, normals: Image, camera: Pinhole, radius: float = 0.04) -> NDArray[np.float32]:
    """(H, W) in 0..1: ambient occlusion of each visible point by its surroundings within ``radius`` m. Points and unit
    normals (H, W, 3) are in the frame of ``camera``, the points without an object are 0; callers blur the result.
    """
    height, width = points.shape[:2]
    rows, columns = np.nonzero(points[..., 2] > 0)
    surroundings = points.reshape(-1, 3)
    points, facing = points[rows, columns], normals[rows, columns]
    reach_x, reach_y = (np.float32(focal * radius) / points[:, 2] for focal in (camera.fx, camera.fy))
    middle_x, middle_y = columns.astype(np.float32) + np.float32(0.5), rows.astype(np.float32) + np.float32(0.5)
    closed = np.zeros(len(points), dtype=np.float32)
    for dx, dy in _SPIRAL:
        index = _pixel(middle_y + dy * reach_y, height) * width + _pixel(middle_x + dx * reach_x, width)
        offset = surroundings[index] - points
        square = np.einsum("nk,nk->n", offset, offset) + np.float32(1e-8)
        rise = np.einsum("nk,nk->n", offset, facing) / np.sqrt(square)
        closed += np.maximum(rise - np.float32(0.12), 0.0) * (square < 4.0 * radius**2)
    shade = np.zeros((height, width), dtype=np.float32)
    shade[rows, columns] = closed / len(_SPIRAL)
    return shade


def _pixel(position: NDArray[np.float32], size: int) -> NDArray[np.int32]:
    """The pixel that holds ``position`` (in pixels from the border), clamped to the image."""
    return np.clip(position, 0, size - 1).astype(np.int32)
