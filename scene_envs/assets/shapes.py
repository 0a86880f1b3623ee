"""Convex parts from a few numbers: boxes, solids of revolution, rings of wedges, rods; and their mass.

All lengths are metres, all points are in the asset frame (z up). Circles are regular polygons whose
corners lie on the nominal circle, so that a diameter is the distance between opposite corners.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.errors import InvalidInputError

Profile = Sequence[tuple[float, float]]
"""Points (r, z) of a half section, m."""
Color = tuple[int, int, int]
"""(r, g, b) in 0..255."""
_SMOOTH = np.cos(np.radians(40.0))
"""Spans of a profile that meet at less than 40 degrees are shaded as one curved surface."""
Face = Literal["-x", "+x", "-y", "+y", "bottom", "top"]
FACES: tuple[Face, ...] = ("-x", "+x", "-y", "+y", "bottom", "top")


class MassProperties(NamedTuple):
    """Mass (kg), centre of mass (3,) m and inertia (3, 3) kg m^2 about the centre of mass, asset axes."""

    mass: float
    center_of_mass: Array
    inertia: Array


def pose_of(translation: ArrayLike, rotation: ArrayLike) -> Array:
    """(4, 4) from a translation (3,) m and a rotation (3, 3)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def convex_hull(points: ArrayLike) -> ConvexPart:
    """The hull of points (P, 3), triangles facing outward; InvalidInputError for fewer than four points or a plane."""
    cloud = np.asarray(points, dtype=np.float64)
    try:
        hull = ConvexHull(cloud)
    except (QhullError, ValueError) as error:
        raise InvalidInputError(
            f"{len(cloud)} points span no volume, so they have no convex hull; give at least four points "
            "that do not lie in one plane"
        ) from error
    triangles = cloud[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, faces = np.unique(faces, return_inverse=True)
    return ConvexPart(cloud[used], faces.reshape(-1, 3).astype(np.int64))


def hull_of(parts: Iterable[ConvexPart]) -> ConvexPart:
    """The convex hull of several parts, as coarse models use it."""
    return convex_hull(np.concatenate([part.vertices for part in parts]))


def box(size: tuple[float, float, float], base: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ConvexPart:
    """An axis-aligned box; ``base`` is the centre of its bottom face.

    >>> box((0.2, 0.1, 0.05)).bounds.tolist()
    [[-0.1, -0.05, 0.0], [0.1, 0.05, 0.05]]
    """
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    return convex_hull(corners * np.asarray(size) + np.asarray(base))


def circle(segments: int, phase: float = 0.0) -> NDArray[np.float64]:
    """(segments, 2): corners of the regular polygon in the unit circle, the first at angle ``phase`` (rad)."""
    angles = phase + 2.0 * np.pi * np.arange(segments) / segments
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def solid(profile: Profile, segments: int, phase: float = 0.0) -> ConvexPart:
    """The convex hull of points (r, z) m revolved about z as a polygon of ``segments`` corners, the first at angle
    ``phase`` (rad): cylinders, frusta, convex bodies; r = 0 gives a single point.

    >>> cylinder = solid([(0.1, 0.0), (0.1, 0.2)], 16)
    >>> len(cylinder.vertices), cylinder.bounds[1].round(3).tolist()
    (32, [0.1, 0.1, 0.2])
    """
    unit = circle(segments, phase)
    layers = [
        np.array([[0.0, 0.0, z]]) if r == 0.0 else np.column_stack([r * unit, np.full(segments, z)]) for r, z in profile
    ]
    return convex_hull(np.concatenate(layers))


def ring(profile: Profile, segments: int, phase: float = 0.0) -> list[ConvexPart]:
    """A convex section of corners (r, z) m, r > 0, swept about z as ``segments`` wedges that touch and do not overlap;
    the first joint is at angle ``phase`` (rad).

    >>> walls = ring([(0.10, 0.0), (0.12, 0.0), (0.12, 0.09), (0.10, 0.09)], 16)
    >>> len(walls), len(walls[0].vertices)
    (16, 8)
    """
    section = np.asarray(profile, dtype=np.float64)
    if (section[:, 0] <= 0).any():
        raise InvalidInputError(f"a ring needs radii above 0 m, got {section[:, 0].min()}; use solid instead")
    unit = circle(segments, phase)
    joints = np.concatenate(
        [section[None, :, :1] * unit[:, None, :], np.broadcast_to(section[None, :, 1:], (segments, len(section), 1))],
        axis=2,
    )  # (segments, P, 3)
    return [convex_hull(np.concatenate([joints[i], joints[(i + 1) % segments]])) for i in range(segments)]


def rods(path: Sequence[tuple[float, float, float]], width: float, thickness: float) -> list[ConvexPart]:
    """Boxes along a path of P points in the x-z plane (m, all with the same y): handles and spouts. ``width`` (m) is
    along y, ``thickness`` (m) across the path. The P - 1 parts share their end faces, cut along the bisector (mitred).
    """
    points = np.asarray(path, dtype=np.float64)
    step = np.diff(points[:, [0, 2]], axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    tangents = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.stack([-tangents[:, 1], np.zeros(len(points)), tangents[:, 0]], axis=1)
    nearest = np.concatenate([step[:1], step])  # mitred ends are longer, so that the thickness stays the same
    scale = 1.0 / np.abs(np.einsum("pi,pi->p", tangents, nearest))
    half = 0.5 * thickness * scale[:, None] * across
    side = np.array([0.0, 0.5 * width, 0.0])
    ends = np.stack([points + half + side, points + half - side, points - half + side, points - half - side], axis=1)
    return [convex_hull(np.concatenate([ends[i], ends[i + 1]])) for i in range(len(points) - 1)]


def volume(parts: Iterable[ConvexPart]) -> float:
    """Summed volume of the parts, m^3 (overlap counts twice)."""
    return float(sum(np.linalg.det(part.vertices[part.faces]).sum() / 6.0 for part in parts))


def mass_properties(parts: Iterable[ConvexPart], mass: float) -> MassProperties:
    """Mass properties of the parts at one density, scaled to ``mass`` kg: exact integrals over the tetrahedra between
    the origin and each face. With ``mass`` 0 the inertia is 0.
    """
    triangles = np.concatenate([part.vertices[part.faces] for part in parts])  # (F, 3, 3)
    volumes = np.linalg.det(triangles) / 6.0
    total = volumes.sum()
    sums = triangles.sum(axis=1)
    center = (volumes[:, None] * sums).sum(axis=0) / (4.0 * total)
    # Integral of x x^T over a tetrahedron (0, a, b, c): V/20 (sum_k v_k v_k^T + s s^T), s = a + b + c.
    second = np.einsum("f,fki,fkj->ij", volumes, triangles, triangles) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    covariance = second / (20.0 * total) - np.outer(center, center)
    inertia = mass * (np.trace(covariance) * np.eye(3) - covariance)
    return MassProperties(mass, center, 0.5 * (inertia + inertia.T))


def winding_number(triangles: Array, point: Array) -> float:
    """How often triangles (F, 3, 3) enclose a point (3,): 1 in a closed surface, -1 in one turned inside out, 0 out of
    both, and a fraction near an open one (Van Oosterom and Strackee, 1983).
    """
    a, b, c = (triangles - point).swapaxes(0, 1)
    ab, bc, ca = (np.einsum("fk,fk->f", *pair) for pair in ((a, b), (b, c), (c, a)))
    a_length, b_length, c_length = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
    volume = np.einsum("fk,fk->f", a, np.cross(b, c))
    rest = a_length * b_length * c_length + ab * c_length + bc * a_length + ca * b_length
    return float(np.arctan2(volume, rest).sum() / (2.0 * np.pi))


def surface(vertices: ArrayLike, faces: ArrayLike, color: Color, normals: ArrayLike | None = None) -> trimesh.Trimesh:
    """One mesh of one colour; normals (V, 3) default to those of the faces around a vertex."""
    vertices = np.asarray(vertices, dtype=np.float64)
    colors = np.tile(np.array([*color, 255], dtype=np.uint8), (len(vertices), 1))
    mesh = trimesh.Trimesh(vertices, np.asarray(faces), vertex_normals=normals, vertex_colors=colors, process=False)
    mesh.vertex_normals  # noqa: B018  (computed here, so that joining keeps them)
    return mesh


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """One mesh of several; colours and normals are kept."""
    starts = [0, *np.cumsum([len(mesh.vertices) for mesh in meshes[:-1]]).tolist()]
    return trimesh.Trimesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        vertex_normals=np.concatenate([mesh.vertex_normals for mesh in meshes]),
        vertex_colors=np.concatenate([mesh.visual.vertex_colors for mesh in meshes]),  # type: ignore[union-attr]
        process=False,
    )


def quad_faces(count: int) -> NDArray[np.int64]:
    """(2 count, 3): two triangles for each of ``count`` quadrilaterals with corners 4 k .. 4 k + 3."""
    first = 4 * np.arange(count)[:, None]
    return np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])


def fan(count: int) -> NDArray[np.int64]:
    """(count - 2, 3): triangles of a convex outline of ``count`` corners."""
    return np.stack([np.zeros(count - 2, dtype=np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)


def sheet(outline: ArrayLike, color: Color) -> trimesh.Trimesh:
    """A flat convex face (P, 3), counter-clockwise seen from its front: a lid, a label, a letter's stroke."""
    points = np.asarray(outline, dtype=np.float64)
    return surface(points, fan(len(points)), color)


def walls(low: Array, high: Array) -> Array:
    """(P, 4, 3): the quadrilaterals between neighbouring corners of two outlines (P, 3)."""
    return np.stack([low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high], axis=1)


def facing(quads: Array) -> Array:
    """(P, 3): unit normals of quadrilaterals (P, 4, 3), by their diagonals."""
    normals = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)  # type: ignore[no-any-return]


def grid_faces(rows: int, around: int) -> NDArray[np.int64]:
    """(2 (rows - 1) around, 3): triangles between neighbouring rows of points, each row closed around."""
    grid = np.arange(rows * around).reshape(rows, around)
    a, b = grid[:-1], np.roll(grid[:-1], -1, axis=1)
    d, c = grid[1:], np.roll(grid[1:], -1, axis=1)
    return np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])


def lathe(
    profile: Profile, colors: Color | Sequence[Color], *, segments: int = 48, phase: float = 0.0, flat: bool = False
) -> trimesh.Trimesh:
    """Revolve an open or closed polyline of P points (r, z) m about z, with the outside on its right: upward on the
    outside of a vessel, downward on its inside. ``colors`` are one, or P - 1 of the spans; ``phase`` (rad) is the angle
    of the first corner; ``flat`` keeps facets visible (square dishes).
    """
    points = np.asarray(profile, dtype=np.float64)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    spans = np.stack([steps[:, 1], -steps[:, 0]], axis=1)  # outward 2-D normals
    palette = [colors] * len(spans) if isinstance(colors[0], int) else list(colors)
    meshes = []
    for index, normal in enumerate(spans):
        ends = []
        for neighbour in (index - 1, index + 1):
            smooth = 0 <= neighbour < len(spans) and float(normal @ spans[neighbour]) > _SMOOTH
            ends.append(normal + spans[neighbour] if smooth else normal)
        meshes.append(_span(points[index], points[index + 1], ends, palette[index], segments, phase, flat))  # type: ignore[arg-type]
    return join(*meshes)


def _span(
    low: Array, high: Array, normals: Sequence[Array], color: Color, segments: int, phase: float, flat: bool
) -> trimesh.Trimesh:
    unit = circle(segments, phase)
    corners = [np.column_stack([r * unit, np.full(segments, z)]) for r, z in (low, high)]
    degenerate = np.array([low[0] == 0.0, high[0] == 0.0])
    keep = np.repeat(~degenerate, segments)  # a span that starts or ends on the axis has half as many triangles
    if flat:
        quads = walls(*corners)
        return surface(quads.reshape(-1, 3), quad_faces(segments)[keep], color, facing(quads).repeat(4, axis=0))
    radial = [np.column_stack([n[0] * unit, np.full(segments, n[1])]) / np.linalg.norm(n) for n in normals]
    return surface(np.concatenate(corners), grid_faces(2, segments)[keep], color, np.concatenate(radial))


def tube(
    path: Sequence[tuple[float, float, float]], radii: ArrayLike, color: Color, *, samples: int = 0, sides: int = 10
) -> trimesh.Trimesh:
    """A round tube along a path of P points (m) in the x-z plane, with flat end caps; ``samples`` puts that many points
    on a smooth curve through the path. ``radii`` (m) is one, or one per point.
    """
    points = arc(path, samples) if samples else np.asarray(path, dtype=np.float64)
    size = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(points),))
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.stack([tangents[:, 2], np.zeros(len(points)), -tangents[:, 0]], axis=1)
    unit = circle(sides)
    spokes = across[:, None] * unit[None, :, :1] + np.array([0.0, 1.0, 0.0]) * unit[None, :, 1:]  # (P, sides, 3)
    return loft(points[:, None] + size[:, None, None] * spokes, color, normals=spokes)


def planks(
    radius: float, z: float, colors: Sequence[Color], *, count: int, rows: int, columns: int = 6
) -> trimesh.Trimesh:
    """A round board seen from above: ``count`` strips along y in turning colours, each cut into ``rows`` x ``columns``
    compact cells, because software renderers walk the bounding box of each triangle.
    """
    edges = np.linspace(-radius, radius, count + 1)
    along = np.linspace(-1.0, 1.0, rows + 1)
    strips = []
    for index, (left, right) in enumerate(pairwise(edges)):
        x = np.linspace(left, right, columns + 1)
        reach = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
        vertices = np.stack(
            [np.repeat(x, rows + 1), np.outer(reach, along).ravel(), np.full(len(x) * (rows + 1), z)], axis=1
        )
        corner = (np.arange(len(x) - 1)[:, None] * (rows + 1) + np.arange(rows)).ravel()
        across = corner + rows + 1
        faces = np.concatenate(
            [np.stack([corner, across, across + 1], axis=1), np.stack([corner, across + 1, corner + 1], axis=1)]
        )
        up = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
        strips.append(surface(vertices, faces, colors[index % len(colors)], up))
    return join(*strips)


def arc(points: Sequence[tuple[float, float, float]], samples: int) -> Array:
    """(samples, 3): a smooth curve through the points, for the visual of handles, spouts and fruit."""
    from scipy.interpolate import make_interp_spline

    knots = np.asarray(points, dtype=np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    spline = make_interp_spline(length, knots, k=min(3, len(knots) - 1))
    return np.asarray(spline(np.linspace(0.0, length[-1], samples)))


class Patch(NamedTuple):
    """A coloured rectangle on a face, in fractions of its width and height as seen from outside."""

    left: float
    low: float
    right: float
    high: float
    color: Color


def painted_face(
    corner: ArrayLike, along: ArrayLike, up: ArrayLike, color: Color, patches: Sequence[Patch] = ()
) -> trimesh.Trimesh:
    """A rectangle with patches on it, later ones over earlier ones: lower left ``corner`` (3,) m, and vectors (3,) m
    ``along`` to the lower right and ``up`` to the upper left corner; ``along x up`` points outward.
    """
    start, right, rise = (np.asarray(v, dtype=np.float64) for v in (corner, along, up))
    across = np.unique(np.clip([0.0, 1.0, *(e for p in patches for e in (p.left, p.right))], 0.0, 1.0))
    upward = np.unique(np.clip([0.0, 1.0, *(e for p in patches for e in (p.low, p.high))], 0.0, 1.0))
    u, v = 0.5 * (across[1:] + across[:-1]), 0.5 * (upward[1:] + upward[:-1])
    palette = [color, *(patch.color for patch in patches)]
    owner = np.zeros((len(u), len(v)), dtype=int)
    for index, patch in enumerate(patches, start=1):
        inside = ((u > patch.left) & (u < patch.right))[:, None] & ((v > patch.low) & (v < patch.high))[None]
        owner[inside] = index
    normal = np.cross(right, rise)
    normal /= np.linalg.norm(normal)
    meshes = []
    for index, cells in _rectangles(owner).items():
        left, low, end, high = np.array(cells).T
        ends = [(across[a], upward[b]) for a, b in ((left, low), (end, low), (end, high), (left, high))]
        corners = np.stack([start + u[:, None] * right + v[:, None] * rise for u, v in ends], axis=1)  # (cells, 4, 3)
        normals = np.tile(normal, (4 * len(cells), 1))
        meshes.append(surface(corners.reshape(-1, 3), quad_faces(len(cells)), palette[index], normals))
    return join(*meshes)


def _rectangles(owner: NDArray[np.int64]) -> dict[int, list[tuple[int, int, int, int]]]:
    """Rectangles (left, low, right, high) of cells, by owner; ``right`` and ``high`` are exclusive. Strips of one owner
    that have the same ends in successive rows are joined.
    """
    joined: dict[int, list[tuple[int, int, int, int]]] = {}
    open_strips: dict[tuple[int, int, int], int] = {}
    for j in range(owner.shape[1] + 1):
        strips: set[tuple[int, int, int]] = set()
        if j < owner.shape[1]:
            starts = np.concatenate([[0], np.flatnonzero(np.diff(owner[:, j])) + 1, [len(owner)]])
            strips = {(int(owner[a, j]), int(a), int(b)) for a, b in pairwise(starts)}
        for strip in sorted(set(open_strips) - strips):
            index, a, b = strip
            joined.setdefault(index, []).append((a, open_strips.pop(strip), b, j))
        for strip in strips:
            open_strips.setdefault(strip, j)
    return joined


def painted_box(
    size: tuple[float, float, float],
    color: Color | Mapping[Face, Color],
    art: Mapping[Face, Sequence[Patch]] | None = None,
    *,
    base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    front: Literal["-y", "+x"] = "-y",
) -> trimesh.Trimesh:
    """An axis-aligned box of side lengths ``size`` (m) with one colour or one per face (all six), and patches per face;
    ``base`` is the centre of the bottom face (m), ``front`` the side from which the top is seen upright.
    """
    colors = color if isinstance(color, Mapping) else dict.fromkeys(FACES, color)
    x, y, z = np.diag(np.asarray(size, dtype=np.float64))
    low = np.asarray(base, dtype=np.float64) - 0.5 * (x + y)
    frames: dict[Face, tuple[Array, Array, Array]] = {
        "-x": (low + y, -y, z),
        "+x": (low + x, y, z),
        "-y": (low, x, z),
        "+y": (low + x + y, -x, z),
        "bottom": (low + y, x, -y),
        "top": (low + z, x, y) if front == "-y" else (low + x + z, y, -x),
    }
    patterns = art or {}
    return join(*(painted_face(*frames[face], colors[face], patterns.get(face, ())) for face in FACES))


def lettering(
    left: float, low: float, right: float, high: float, color: Color, widths: Sequence[float] = (1.0,) * 6
) -> list[Patch]:
    """Patches that look like a line of large letters: bars of these relative widths with gaps between."""
    gap = 0.34
    total = sum(widths) + gap * (len(widths) - 1)
    patches, x = [], left
    for width in widths:
        step = (right - left) / total
        patches.append(Patch(x, low, x + width * step, high, color))
        x += (width + gap) * step
    return patches


def tiles(palette: Sequence[Color], columns: Sequence[str]) -> list[Patch]:
    """Patches that cover a face: columns of digits from left to right, each upward, that choose from ``palette``."""
    across, up = len(columns), len(columns[0])
    return [
        Patch(i / across, j / up, (i + 1) / across, (j + 1) / up, palette[int(digit)])
        for i, column in enumerate(columns)
        for j, digit in enumerate(column)
    ]


def loft(
    sections: ArrayLike, color: Color, *, caps: tuple[bool, bool] = (True, True), normals: Array | None = None
) -> trimesh.Trimesh:
    """A smooth skin through P sections of K points each (P, K, 3), m, with flat caps at its first and last end. The
    points run counter-clockwise when seen from the last section looking back at the first. ``normals`` (P, K, 3) of the
    skin default to those of the faces around a point.
    """
    grid = np.asarray(sections, dtype=np.float64)
    count, around = grid.shape[:2]
    ends = [surface(grid[0], fan(around)[:, ::-1], color), sheet(grid[-1], color)]
    shading = None if normals is None else normals.reshape(-1, 3)
    return join(
        surface(grid.reshape(-1, 3), grid_faces(count, around), color, shading),
        *(end for end, kept in zip(ends, caps, strict=True) if kept),
    )


def moved(mesh: trimesh.Trimesh, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """The mesh at another pose: rotation (3, 3), then translation (3,) m; colours are kept."""
    turn = np.asarray(rotation, dtype=np.float64)
    visual: Any = mesh.visual
    return trimesh.Trimesh(
        vertices=mesh.vertices @ turn.T + np.asarray(translation),
        faces=mesh.faces,
        vertex_normals=mesh.vertex_normals @ turn.T,
        vertex_colors=visual.vertex_colors,
        process=False,
    )
