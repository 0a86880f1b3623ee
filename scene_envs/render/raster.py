"""Rasteriser of triangles in NumPy: which triangle a pinhole camera sees in each pixel, and how far away it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index, ranges
from scene_envs.errors import InvalidInputError

_BATCH = 1 << 21
"""Pixels of triangles that are tested at once, which bounds the memory."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera.

    >>> camera = Pinhole.at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 90.0, 20, 10)
    >>> (camera.view @ [1.0, 0.5, 0.0, 1.0]).round(9).tolist()  # right, up, backward
    [1.0, 0.5, -2.0, 1.0]
    """

    view: Array  # (4, 4) transform from world to camera (x right, y up, z backward)
    focal: Array  # (2,) focal lengths, in half image widths and heights
    near: float  # m; what is nearer than this along the viewing direction is cut off
    width: int  # pixels
    height: int

    @classmethod
    def at(
        cls,
        position: tuple[float, float, float],
        target: tuple[float, float, float],
        up: tuple[float, float, float],
        fov_y: float,
        width: int,
        height: int,
    ) -> Pinhole:
        """The camera at ``position`` (m) that looks at ``target`` (m), with a vertical field of view in degrees.

        Raises InvalidInputError where position and target are the same point, or ``up`` is along the view.
        """
        back = np.subtract(position, target, dtype=np.float64)
        distance = float(np.linalg.norm(back))
        right = np.cross(up, back)
        if not np.linalg.norm(right) > 1e-9 * distance * np.linalg.norm(up):
            raise InvalidInputError(
                f"a camera at {position} cannot look at {target} with {up} up: give another target, or an up that is "
                "not along the view"
            )
        back /= distance
        right /= np.linalg.norm(right)
        view = np.eye(4)
        view[:3, :3] = right, np.cross(back, right), back
        view[:3, 3] = -view[:3, :3] @ position
        focal = 1.0 / np.tan(np.radians(fov_y) / 2.0)
        return cls(view, np.array([focal * height / width, focal]), 0.01 * distance, width, height)

    def project(self, points: Array) -> Array:
        """(..., 3): column and row (pixels, from the upper left corner), and 1 / depth (1/m), of points (..., 3) in the
        camera frame.
        """
        nearness = -1.0 / points[..., 2]
        column = (points[..., 0] * nearness * self.focal[0] + 1.0) * (0.5 * self.width)
        row = (1.0 - points[..., 1] * nearness * self.focal[1]) * (0.5 * self.height)
        return np.stack([column, row, nearness], axis=-1)


def visible_triangles(triangles: Array, camera: Pinhole) -> tuple[Index, NDArray[np.float32]]:
    """The nearest triangle through the centre of each pixel.

    Triangles, (T, 3, 3) corners in the camera frame in m, are seen from both sides. Two that share an edge leave no
    gap, and no pixel centre belongs to both. The results are the (H, W) index of the triangle, -1 without one; and the
    (H, W) float32 distance along the viewing direction (m), inf without one.

    >>> camera = Pinhole.at((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 90.0, 4, 4)
    >>> faces, depth = visible_triangles(np.array([[[-9.0, 0.0, -2.0], [9.0, 0.0, -2.0], [0.0, 9.0, -2.0]]]), camera)
    >>> faces[:, 0].tolist(), depth[:, 0].tolist()
    ([0, 0, -1, -1], [2.0, 2.0, inf, inf])
    """
    corners, owners = _in_front(triangles, camera.near)
    points = camera.project(corners)
    ends = (limit(limit(points[:, 0], points[:, 1]), points[:, 2])[:, :2] for limit in (np.minimum, np.maximum))
    low, high = (np.ceil(np.clip(end, 0, (camera.width, camera.height)) - 0.5) for end in ends)
    (kept,) = np.nonzero((high > low).all(axis=1))  # those around the centre of a pixel
    points, owners, first = points[kept], owners[kept], low[kept, 1].astype(np.int64)
    counts = high[kept, 1].astype(np.int64) - first
    order = np.argsort(points[..., 1], axis=1)
    points = np.take_along_axis(points, order[..., None], axis=1)  # from the top down

    of, rows = ranges(first, counts)
    spans = _spans(points, of, rows.astype(np.float64) + 0.5)
    begin = np.ceil(np.clip(spans[0], 0, camera.width) - 0.5).astype(np.int64)
    end = np.ceil(np.clip(spans[1], 0, camera.width) - 0.5).astype(np.int64)
    (kept,) = np.nonzero(end > begin)
    lengths, begin = (end - begin)[kept], begin[kept]
    x, _, q, slope = (values[kept] for values in spans)
    offset = q + (0.5 - x) * slope  # 1 / depth at column 0
    base = rows[kept] * camera.width

    best = np.zeros(camera.height * camera.width, dtype=np.uint64)
    total = np.cumsum(lengths)
    start = 0
    while start < len(lengths):
        done = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, done + _BATCH, side="right")))
        part = slice(start, stop)
        span, columns = ranges(begin[part], lengths[part])
        nearness = (offset[part][span] + slope[part][span] * columns).astype(np.float32)
        # Positive floats are ordered as their bits are: the nearest span has the largest key.
        keys = nearness.view(np.uint32).astype(np.uint64) << np.uint64(32) | (span + start + 1).astype(np.uint64)
        np.maximum.at(best, base[part][span] + columns, keys)
        start = stop
    seen = best > 0
    faces = np.full(len(best), -1, dtype=np.int64)
    depth = np.full(len(best), np.inf, dtype=np.float32)
    winners = (best[seen] & np.uint64(0xFFFFFFFF)).astype(np.int64) - 1
    faces[seen] = owners[of[kept[winners]]]
    depth[seen] = np.float32(1.0) / (best[seen] >> np.uint64(32)).astype(np.uint32).view(np.float32)
    shape = (camera.height, camera.width)
    return faces.reshape(shape), depth.reshape(shape)


def corner_weights(triangles: Array, faces: Index, rows: Index, columns: Index, camera: Pinhole) -> Array:
    """(P, 2): weights of the second and third corner in the point of triangle ``faces`` (P,) that pixels see.

    The weight of the first corner is the rest to 1. Triangles (T, 3, 3) are in the camera frame.
    """
    used, at = np.unique(faces, return_inverse=True)
    corners = triangles[used]
    # Where a ray d meets the plane of a triangle, the weights are proportional to d . (b x c), d . (c x a), d . (a x b)
    across = np.cross(corners[:, [1, 2, 0]], corners[:, [2, 0, 1]])
    x = ((columns + 0.5) * (2.0 / camera.width) - 1.0) / camera.focal[0]
    y = (1.0 - (rows + 0.5) * (2.0 / camera.height)) / camera.focal[1]
    normals = across.reshape(-1, 9)[at.ravel()]
    weights = normals[:, 0::3] * x[:, None] + normals[:, 1::3] * y[:, None] - normals[:, 2::3]
    total = weights.sum(axis=1)
    share = weights[:, 1:] / np.where(total == 0.0, 1.0, total)[:, None]
    return np.clip(share, 0.0, 1.0)


def _in_front(triangles: Array, near: float) -> tuple[Array, Index]:
    """The parts of triangles beyond the near plane, as triangles, and the index of the triangle of each."""
    inside = triangles[..., 2] < -near
    count = inside.sum(axis=1)
    (whole,), (one,), (two,) = (np.nonzero(count == number) for number in (3, 1, 2))
    parts, owners = [triangles[whole]], [whole]
    if len(one):  # its corner, and the two points where its edges leave
        turn = (np.argmax(inside[one], axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[one], turn[..., None], axis=1), 1, 0)
        parts.append(np.stack([a, _leave(a, b, near), _leave(a, c, near)], axis=1))
        owners.append(one)
    if len(two):  # a quadrilateral, in two triangles
        turn = (np.argmin(inside[two], axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(triangles[two], turn[..., None], axis=1), 1, 0)
        to_b, to_c = _leave(b, a, near), _leave(c, a, near)
        parts += [np.stack([b, c, to_b], axis=1), np.stack([to_b, c, to_c], axis=1)]
        owners += [two, two]
    return np.concatenate(parts), np.concatenate(owners)


def _leave(inside: Array, outside: Array, near: float) -> Array:
    """The point of the edge between two points (P, 3) that lies in the near plane."""
    share = (inside[:, 2] + near) / (inside[:, 2] - outside[:, 2])
    return inside + share[:, None] * (outside - inside)


def _spans(points: Array, of: Index, y: Array) -> tuple[Array, Array, Array, Array]:
    """Where triangles ``of`` (S,) cross the horizontal lines ``y`` (S,): left and right end (pixels), 1 / depth at the
    left end and its slope. Corners (T, 3, 3) are sorted by y, so neighbours compute the same end on their shared edge.
    """
    top, middle, bottom = (points[:, k][of] for k in range(3))
    upper = y < middle[:, 1]
    a, b = np.where(upper[:, None], top, middle), np.where(upper[:, None], middle, bottom)
    long, short = (
        first + ((y - first[:, 1]) / np.maximum(second[:, 1] - first[:, 1], 1e-300))[:, None] * (second - first)
        for first, second in ((top, bottom), (a, b))
    )
    swap = (long[:, 0] > short[:, 0])[:, None]
    left, right = np.where(swap, short, long), np.where(swap, long, short)
    slope = (right[:, 2] - left[:, 2]) / np.maximum(right[:, 0] - left[:, 0], 1e-12)
    return left[:, 0], right[:, 0], left[:, 2], slope
