"""Penetration depths of pairs of convex parts, random and degenerate, beside the hull of the Minkowski difference.

    python benchmarks/narrowphase.py [--count 100000] [--seed 0]

The reference is the distance from the origin to the nearest face of the convex hull (Qhull) of all differences of
corners; where that hull has no volume, the depth is 0. Parts are those of all asset libraries, random polytopes of 4
to 24 corners with copies scaled by 0.1 to 0.9, and slivers: boxes 1 nm to 0.1 mm thick, flat polygons, lines, points.
A contact puts a corner, edge or face of one part onto one of the other with opposite normals, then moves one of them
by up to 1 mm, by rounding, or not at all. An error above 10 µm is a failure.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from scene_envs.physics.mujoco import Overlaps
from scene_envs.physics.placement import PlacedParts
from scene_envs.scene_types import get_scene_type, list_scene_types

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pair = tuple[Array, Array, Array, Array]
"""Rotation and translation of the first part, then of the second."""

FAILURE, NOTED = 1e-5, 1e-6
"""Errors (m) above which a depth is wrong, and above which it is counted."""
_SAME_NORMAL = 1e-10
"""Faces whose unit normals differ by less than this are one face."""
_MIN_EXTENT = 1e-12
"""Relative size below which a part is a point, width below which a flat part is a line, and height that counts as 0."""
SMALL = (0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 1e-3)
"""Depths (m) to which touching features are pushed in, or by which they are pulled apart."""


def minkowski_depth(first: Array, second: Array) -> float:
    """Depth (m) of two convex bodies from their corners in the world; negative when they are apart."""
    try:
        return float(-ConvexHull((first[:, None] - second[None]).reshape(-1, 3)).equations[:, 3].max())
    except QhullError:  # no volume
        return 0.0


def library_parts() -> list[Array]:
    """Corners of the distinct parts of all scene types' assets."""
    names = {(name, asset) for name in list_scene_types() for asset in get_scene_type(name).assets}
    assets = {asset: get_scene_type(name).library[asset] for name, asset in sorted(names)}
    return [part.vertices for asset in assets.values() for part in (*asset.fine, *asset.coarse)]


def polytopes(count: int, rng: np.random.Generator) -> list[Array]:
    """Random polytopes of 4 to 24 corners, about 0.1 m wide; every second one is the one before, scaled down."""
    found: list[Array] = []
    while len(found) < count:
        whole = 0.05 * rng.standard_normal((int(rng.integers(4, 25)), 3))
        found += [whole, rng.uniform(0.1, 0.9) * whole]
    return found[:count]


def slivers(rng: np.random.Generator) -> list[Array]:
    """Parts without thickness, or with next to none."""
    square = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)]) - 0.5
    boxes = [square * (0.1, 0.07, thickness) for thickness in np.logspace(-9, -4, 11)]
    needles = [square * (0.1, thickness, thickness) for thickness in np.logspace(-9, -4, 11)]
    polygons = [np.c_[0.05 * rng.standard_normal((count, 2)), np.zeros(count)] for count in (3, 4, 8, 16)]
    return [*boxes, *needles, *polygons, np.array([[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]), np.zeros((1, 3))]


@dataclass(frozen=True, eq=False)
class PartFeatures:
    """Features of one convex part, asset frame. A part without thickness has two opposite faces, whose edges are those
    of the polygon; a line is a polygon of two equal edges, and a point has no edges.
    """

    normals: Array  # (K, 3) unit outward normals of its distinct faces
    edge_faces: Index  # (E, 2) the two distinct faces of an edge
    edge_outward: Array  # (E, 3) unit vectors halfway between the normals of the two faces

    @classmethod
    def of(cls, vertices: Array) -> PartFeatures:
        """Features of the convex hull of ``vertices`` (V, 3), m, which may be flat."""
        try:
            hull = ConvexHull(vertices)
        except (QhullError, ValueError):
            return cls._flat(vertices)
        normals, face = _distinct(hull.equations[:, :3])
        here, side = np.nonzero(np.arange(len(face))[:, None] < hull.neighbors)
        there = hull.neighbors[here, side]
        ends = np.stack([hull.simplices[here, (side + 1) % 3], hull.simplices[here, (side + 2) % 3]], axis=1)
        bent = face[here] != face[there]
        faces = np.stack([face[here], face[there]], axis=1)[bent]
        return cls._with_edges(vertices[np.sort(hull.vertices)], normals, vertices[ends[bent]], faces)

    @classmethod
    def _flat(cls, vertices: Array) -> PartFeatures:
        middle = vertices.mean(axis=0)
        _, sizes, axes = np.linalg.svd(vertices - middle)
        if len(vertices) < 2 or sizes[0] <= _MIN_EXTENT * np.abs(vertices).max():
            normals = np.concatenate([np.eye(3), -np.eye(3)])
            return cls._with_edges(vertices[:1], normals, np.empty((0, 2, 3)), np.empty((0, 2), dtype=np.int64))
        flat = (vertices - middle) @ axes[:2].T
        try:
            outline = ConvexHull(flat).vertices if len(sizes) > 1 and sizes[1] > _MIN_EXTENT * sizes[0] else None
        except QhullError:
            outline = None
        if outline is None:
            outline = np.array([flat[:, 0].argmin(), flat[:, 0].argmax()])
        ends = np.stack([vertices[outline], vertices[np.roll(outline, -1)]], axis=1)
        faces = np.tile(np.array([[0, 1]], dtype=np.int64), (len(ends), 1))
        return cls._with_edges(vertices, np.stack([axes[2], -axes[2]]), ends, faces)

    @classmethod
    def _with_edges(cls, corners: Array, normals: Array, ends: Array, faces: Index) -> PartFeatures:
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        along, ends, faces = along[length > 0] / length[length > 0, None], ends[length > 0], faces[length > 0]
        one, two = normals[faces[:, 0]], normals[faces[:, 1]]
        blunt = np.einsum("ei,ei->e", one, two) > 0
        # the sum of nearly opposite normals is lost to rounding, and so is the difference of nearly equal ones
        outward = np.where(blunt[:, None], one + two, np.cross(along, two - one))
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        middle = corners.mean(axis=0)
        height = np.einsum("ei,ei->e", outward, ends.mean(axis=1) - middle)
        # the outward vectors of the two edges of a line, at height 0, are opposite already
        outward[height < -_MIN_EXTENT * np.abs(corners - middle).max()] *= -1.0
        return cls(normals, faces, outward)


def _distinct(normals: Array) -> tuple[Array, Index]:
    """Distinct unit normals (K, 3), and the index (F,) of each face's normal among them."""
    exact, face = np.unique(normals, axis=0, return_inverse=True)
    face = face.ravel()
    group = np.arange(len(exact))
    for index in range(1, len(exact)):
        near = np.abs(exact[:index] - exact[index]).max(axis=1) < _SAME_NORMAL
        if near.any():
            group[index] = group[int(near.argmax())]
    kept, number = np.unique(group, return_inverse=True)
    return exact[kept], number.ravel()[face]


class PairMaker:
    """Random poses of pairs of parts in given kinds of contact.

    Args:
        parts: corners (V, 3) of each part, m.
        rng: random numbers.
    """

    def __init__(self, parts: Sequence[Array], rng: np.random.Generator) -> None:
        self.parts, self.rng = parts, rng
        self.features = [PartFeatures.of(corners) for corners in parts]

    def pose(self) -> tuple[Array, Array]:
        """Any rotation, and a translation within 0.5 m."""
        return Rotation.random(random_state=self.rng).as_matrix(), self.rng.uniform(-0.5, 0.5, 3)

    def overlapping(self, a: int, b: int) -> Pair:
        """Two random interior points coincide."""
        (rotation_a, translation_a), (rotation_b, _) = self.pose(), self.pose()
        inner = [self.rng.dirichlet(np.ones(len(self.parts[i]))) @ self.parts[i] for i in (a, b)]
        return rotation_a, translation_a, rotation_b, translation_a + rotation_a @ inner[0] - rotation_b @ inner[1]

    def nested(self, a: int, b: int) -> Pair:
        """The two middles coincide, and in one pair of three the axes too."""
        rotation, translation = self.pose()
        other = rotation if self.rng.random() < 1 / 3 else self.pose()[0]
        middle = [self.parts[i].mean(axis=0) for i in (a, b)]
        return rotation, translation, other, translation + rotation @ middle[0] - other @ middle[1]

    def coincident(self, a: int, b: int) -> Pair:
        """Equal poses, up to rounding."""
        rotation, translation = self.pose()
        return rotation, translation, rotation, translation + self.rng.choice(SMALL[:4]) * self.rng.standard_normal(3)

    def touching(self, a: int, kind_a: str, b: int, kind_b: str, tilt: float = 0.0) -> Pair:
        """Two features meet with opposite normals, moved by one of ``SMALL`` m, in or out, and tilted (rad)."""
        rotation_a, translation_a = self.pose()
        point_a, normal_a = self._feature(a, kind_a)
        point_b, normal_b = self._feature(b, kind_b)
        normal = rotation_a @ normal_a
        rotation_b = _onto(normal_b, -normal, self.rng.uniform(0, 2 * np.pi) if self.rng.random() < 0.7 else 0.0)
        across = np.cross(normal, self.rng.standard_normal(3))
        rotation_b = Rotation.from_rotvec(tilt * across / np.linalg.norm(across)).as_matrix() @ rotation_b
        push = self.rng.choice(SMALL) * self.rng.choice((-1.0, 1.0, 1.0))
        return rotation_a, translation_a, rotation_b, (
            translation_a + rotation_a @ point_a - push * normal - rotation_b @ point_b
        )  # fmt: skip

    def _feature(self, part: int, kind: str) -> tuple[Array, Array]:
        """A random point on a corner, edge or face, and a random unit vector among the normals there."""
        corners, features = self.parts[part], self.features[part]
        if kind == "edge" and len(features.edge_faces):
            edge = int(self.rng.integers(len(features.edge_faces)))
            normals = features.normals[features.edge_faces[edge]]
            weights = self.rng.dirichlet(np.ones(3))
            normal = weights[:2] @ normals + weights[2] * features.edge_outward[edge]
            heights = corners @ features.edge_outward[edge]
        elif kind == "face":
            normal = features.normals[int(self.rng.integers(len(features.normals)))]
            heights = corners @ normal
        else:
            normal = self.rng.standard_normal(3)
            heights = corners @ normal
            return corners[int(heights.argmax())], normal / np.linalg.norm(normal)
        on = corners[heights > heights.max() - 1e-12]
        return self.rng.dirichlet(np.ones(len(on))) @ on, normal / np.linalg.norm(normal)


def _onto(source: Array, target: Array, spin: float) -> Array:
    """A rotation that takes one unit vector to another, then turns about it by ``spin`` (rad)."""
    turn, _ = Rotation.align_vectors(target[None], source[None])
    return np.asarray((Rotation.from_rotvec(spin * target) * turn).as_matrix())


def kinds(library: int, whole: int, maker: PairMaker) -> dict[str, Callable[[], tuple[int, int, Pair]]]:
    """Makers of one pair of each kind: the two parts and their poses.

    Args:
        library: number of parts from libraries, which come first. Polytopes follow; every second one is a scaled copy
            of the one before.
        whole: number of parts with volume; slivers follow.
        maker: poses of all parts.
    """
    rng = maker.rng

    def two(first: int = 0, last: int = whole) -> tuple[int, int]:
        return int(rng.integers(first, last)), int(rng.integers(whole))

    def contact(one: str, other: str) -> tuple[int, int, Pair]:
        a, b = two()
        return a, b, maker.touching(a, one, b, other)

    def same() -> tuple[int, int, Pair]:
        a = int(rng.integers(len(maker.parts)))
        return a, a, maker.coincident(a, a)

    def tilted() -> tuple[int, int, Pair]:
        a, b = two()
        return a, b, maker.touching(a, "face", b, "face", tilt=10.0 ** rng.uniform(-12, -3))

    def flat() -> tuple[int, int, Pair]:
        a, b = two(whole, len(maker.parts))
        if rng.random() < 0.2:
            b = int(rng.integers(whole, len(maker.parts)))
        one, other = rng.choice(("corner", "edge", "face"), 2)
        return a, b, maker.overlapping(a, b) if rng.random() < 0.4 else maker.touching(a, one, b, other)

    def inside() -> tuple[int, int, Pair]:
        a, b = two()
        if rng.random() < 0.5:
            a = library + 2 * int(rng.integers((whole - library) // 2))
            b = a + 1
        return a, b, maker.nested(a, b)

    def any_pose() -> tuple[int, int, Pair]:
        a, b = two()
        return a, b, maker.overlapping(a, b)

    return {
        "overlapping at random": any_pose,
        "corner on corner": lambda: contact("corner", "corner"),
        "corner on edge": lambda: contact("corner", "edge"),
        "corner on face": lambda: contact("corner", "face"),
        "edge on edge": lambda: contact("edge", "edge"),
        "edge on face": lambda: contact("edge", "face"),
        "face on face": lambda: contact("face", "face"),
        "faces tilted, 1e-12 to 1e-3": tilted,
        "coincident": same,
        "nested": inside,
        "slivers": flat,
    }


def sample(count: int, seed: int) -> tuple[list[Array], PlacedParts, list[str]]:
    """Parts, ``count`` pairs of them (rows ``p`` and ``count + p``), and the kind of each pair."""
    rng = np.random.default_rng(seed)
    library = library_parts()
    whole = library + polytopes(200, rng)
    maker = PairMaker(whole + slivers(rng), rng)
    makers = kinds(len(library), len(whole), maker)
    names = [list(makers)[index % len(makers)] for index in range(count)]
    made = [makers[name]() for name in names]
    part = np.array([item[0] for item in made] + [item[1] for item in made], dtype=np.int64)
    poses = [item[2] for item in made]
    rotation = np.stack([pose[0] for pose in poses] + [pose[2] for pose in poses])
    translation = np.stack([pose[1] for pose in poses] + [pose[3] for pose in poses])
    return list(maker.parts), PlacedParts(part, rotation, translation), names


def measured(overlaps: Overlaps, placed: PlacedParts, first: Index, second: Index) -> Array:
    """Depths (P,) m of the pairs of rows ``first`` (P,) and ``second`` (P,), each a scene of its own; 0 where they do
    not overlap. ``overlaps`` has one body for each part.
    """
    rows, pair, depth = np.concatenate([first, second]), np.arange(len(first)), np.zeros(len(first))
    poses = placed.part[rows], placed.rotation[rows], placed.translation[rows]
    one, _, found, _ = overlaps(*poses, pair, pair + len(pair), np.tile(pair, 2))
    depth[one] = found
    return depth


def expected_depths(parts: Sequence[Array], placed: PlacedParts, first: Index, second: Index) -> Array:
    """Depths (P,) m of the same pairs by the reference, negative where they are apart; the first part is put at the
    origin, where the reference rounds as little as it can.
    """
    turn = placed.rotation[first].swapaxes(1, 2)
    shift = np.einsum("pij,pj->pi", turn, placed.translation[second] - placed.translation[first])
    turn = turn @ placed.rotation[second]
    corners = [(parts[placed.part[a]], parts[placed.part[b]]) for a, b in zip(first, second, strict=True)]
    return np.array([
        minkowski_depth(one, other @ turn[row].T + shift[row]) for row, (one, other) in enumerate(corners)
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    parts, placed, names = sample(options.count, options.seed)
    rows = np.arange(options.count)
    overlaps = Overlaps(parts, [[index] for index in range(len(parts))])
    measured(overlaps, placed, rows[:1], rows[:1] + options.count)  # makes the model
    start = time.process_time()
    depth = measured(overlaps, placed, rows, rows + options.count)
    spent = time.process_time() - start
    expected = np.maximum(expected_depths(parts, placed, rows, rows + options.count), 0.0)
    error = np.abs(depth - expected)
    columns = "kind", "pairs", "overlapping", "largest error, m", "above 1 µm", "failures"
    table = Table(*columns, title=f"{options.count} pairs")
    for name in dict.fromkeys(names):
        of_kind = np.array([other == name for other in names])
        counts = (~(error[of_kind] <= limit) for limit in (NOTED, FAILURE))
        overlapping, (noted, failures) = int((expected[of_kind] > 0).sum()), (int(count.sum()) for count in counts)
        largest = f"{error[of_kind].max():.1e}"
        table.add_row(name, *map(str, (of_kind.sum(), overlapping, largest, noted, failures)))
    console = Console()
    console.print(table)
    console.print(f"{1e6 * spent / options.count:.1f} µs of CPU time per pair")
    missed, false = ((expected > 2 * NOTED) & (depth == 0)).sum(), ((expected == 0) & (depth > FAILURE)).sum()
    console.print(f"{missed} overlaps above 2 µm missed, {false} pairs that do not overlap called deep")
    for row in np.argsort(error)[::-1][:5]:
        if error[row] > FAILURE:
            console.print(f"pair {row}, {names[row]}: {depth[row]:.3e} m, expected {expected[row]:.3e} m")


if __name__ == "__main__":
    main()
