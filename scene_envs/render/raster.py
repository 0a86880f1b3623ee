"""Pinhole cameras, and a rasteriser in NumPy: which triangle a camera sees in each pixel, and how far away it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index, ranges
from scene_envs.errors import FINITE, Checked, Count, InvalidInputError, Positive

Triple = tuple[float, float, float]
_CHUNK = 1 << 17
"""Pixels of triangles that are tested at once: their arrays stay in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Pinhole(Checked):
    """A pinhole camera by intrinsics and pose, with the axes of OpenCV: x right, y down, z forward along the view.

    Attributes:
        pose: (4, 4) transform from the camera frame to the world: columns right, down, forward and position (m).
        fx: Focal length along rows of the image, pixels.
        fy: Focal length along columns of the image, pixels.
        cx: Principal point from the left border, pixels. The middle of the first pixel is at 0.5; a calibration that
            has it at 0, as OpenCV's, needs 0.5 more.
        cy: Principal point from the upper border, pixels, counted in the same way.
        width: Image width, pixels.
        height: Image height, pixels.
        near: Depth (m) up to which nothing is seen.

    Raises:
        InvalidInputError: a pose that is no rigid motion, or a focal length, size or near depth that is not above 0.

    >>> camera = Pinhole.at((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 90.0, 20, 10)
    >>> (camera.view @ [1.0, 0.5, 0.0, 1.0]).round(9).tolist()  # right, down, forward
    [1.0, -0.5, 2.0, 1.0]
    """

    pose: Array
    fx: Positive
    fy: Positive
    cx: Annotated[float, FINITE]
    cy: Annotated[float, FINITE]
    width: Count
    height: Count
    near: Positive = 0.01
    place = "a camera's "

    def __post_init__(self) -> None:
        super().__post_init__()
        pose = np.array(self.pose, dtype=np.float64)
        object.__setattr__(self, "pose", pose)
        turn = pose[:3, :3] if pose.shape == (4, 4) and np.isfinite(pose).all() else np.zeros((3, 3))
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0 or (pose[3] != [0, 0, 0, 1]).any():
            raise InvalidInputError(
                "the pose of a camera is a (4, 4) rigid motion of the columns right, down, forward, position, with the "
                f"last row 0 0 0 1; got {pose.tolist()}"
            )

    @classmethod
    def at(cls, position: Triple, target: Triple, up: Triple, fov_y: float, width: int, height: int) -> Pinhole:
        """The camera at ``position`` (m) that looks at ``target`` (m), with a vertical field of view in degrees.

        Raises InvalidInputError where position and target are the same point, or ``up`` is along the view, or the field
        of view is not between 0 and 180 degrees.
        """
        if not 0.0 < fov_y < 180.0:
            raise InvalidInputError(f"a camera's field of view must be between 0 and 180 degrees, got fov_y={fov_y}")
        forward = np.subtract(target, position, dtype=np.float64)
        distance = float(np.linalg.norm(forward))
        right = np.cross(forward, up)
        if not np.linalg.norm(right) > 1e-9 * distance * np.linalg.norm(up):
            raise InvalidInputError(
                f"a camera at {position} cannot look at {target} with {up} up: give another target, or an up that is "
                "not along the view"
            )
        forward /= distance
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
        focal = 0.5 * height / float(np.tan(np.radians(fov_y) / 2.0))
        return cls(pose, focal, focal, 0.5 * width, 0.5 * height, width, height, 0.01 * distance)

    @property
    def view(self) -> Array:
        """(4, 4) transform from the world to the camera frame."""
        return np.asarray(np.linalg.inv(self.pose), dtype=np.float64)

    def resized(self, width: int, height: int) -> Pinhole:
        """The same view in another number of pixels; another aspect stretches the image."""
        x, y = width / self.width, height / self.height
        return Pinhole(self.pose, x * self.fx, y * self.fy, x * self.cx, y * self.cy, width, height, self.near)

    def rays(self, columns: NDArray[np.floating], rows: NDArray[np.floating]) -> NDArray[np.float32]:
        """(..., 3): the points at depth 1 m, camera frame, that are seen at places of the image (pixels)."""
        columns, rows = np.broadcast_arrays((columns - self.cx) / self.fx, (rows - self.cy) / self.fy)
        return np.stack([columns, rows, np.ones_like(rows)], axis=-1).astype(np.float32)


def visible_triangles(points: Array, faces: Index, camera: Pinhole) -> tuple[Index, NDArray[np.float32]]:
    """The nearest triangle through the centre of each pixel.

    Triangles have corners ``faces`` (T, 3) among ``points`` (V, 3), camera frame in m, and are seen from both sides.
    Two that share an edge leave no gap, and no pixel centre belongs to both. The results are the (H, W) index of the
    triangle, -1 without one; and the (H, W) float32 depth along the view (m), inf without one.

    >>> camera = Pinhole(np.eye(4), 2.0, 2.0, 2.0, 2.0, 4, 4)
    >>> corners = np.array([[-9.0, 0.0, 2.0], [9.0, 0.0, 2.0], [0.0, 9.0, 2.0]])
    >>> faces, depth = visible_triangles(corners, np.array([[0, 1, 2]]), camera)
    >>> faces[:, 0].tolist(), depth[:, 0].tolist()
    ([-1, -1, 0, 0], [inf, inf, 2.0, 2.0])
    """
    front = points[:, 2] > camera.near
    corners, owners = np.ascontiguousarray(faces.T), np.arange(len(faces))  # (3, T), (T,)
    if not front.all():
        count = front[corners].sum(axis=0)
        (owners,), (cut,) = np.nonzero(count == 3), np.nonzero((count > 0) & (count < 3))
        parts, of = _in_front(points[faces[cut]], camera.near)
        corners = np.concatenate([corners[:, owners], len(points) + np.arange(3 * len(parts)).reshape(-1, 3).T], axis=1)
        points, owners = np.concatenate([points, parts.reshape(-1, 3)]), np.concatenate([owners, cut[of]])
    nearness = 1.0 / np.maximum(points[:, 2], camera.near)
    column = points[:, 0] * nearness * camera.fx + camera.cx
    row = points[:, 1] * nearness * camera.fy + camera.cy
    x, y = column[corners], row[corners]
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    first, last = _pixels(y.min(axis=0), camera.height), _pixels(y.max(axis=0), camera.height)
    in_image = (last > first) & (x.max(axis=0) > 0.5) & (x.min(axis=0) < camera.width)
    (kept_at,) = np.nonzero(in_image & (np.abs(area) > 1e-12))
    owners, first, last, corners = owners[kept_at], first[kept_at], last[kept_at], corners[:, kept_at]
    corners = np.take_along_axis(corners, np.argsort(row[corners], axis=0), axis=0)  # from the top down

    # On each line of pixels a triangle covers the span between its long edge and one of the two others; 1 / depth is
    # linear in the image. Neighbours compute the same end on their shared edge, whose upper corner is taken first.
    x, y, q = (values[corners] for values in (column, row, nearness))
    (ux, vx), (uy, vy), (uq, vq) = (values[1:] - values[0] for values in (x, y, q))
    area = ux * vy - vx * uy
    along, across, down = _slope(vx, vy), (uq * vy - vq * uy) / area, (ux * vq - vx * uq) / area
    split = _pixels(y[1], camera.height)
    of, rows = ranges(np.concatenate([first, split]), np.concatenate([split - first, last - split]))
    beside = np.append(_slope(ux, uy), _slope(vx - ux, vy - uy))  # of the upper and the lower short edges
    x_short, y_short, beside = (values[of] for values in (x[:2].ravel(), y[:2].ravel(), beside))
    of -= (of >= len(owners)) * len(owners)
    place = rows + 0.5
    rise = place - y[0][of]
    ends = x[0][of] + rise * along[of], x_short + (place - y_short) * beside
    begin, end = _pixels(np.minimum(*ends), camera.width), _pixels(np.maximum(*ends), camera.width)
    (spans,) = np.nonzero(end > begin)
    of, begin, lengths, rise = of[spans], begin[spans], (end - begin)[spans], rise[spans]
    across = across[of]
    left = (q[0][of] + down[of] * rise + across * (begin + 0.5 - x[0][of])).astype(np.float32)
    across = across.astype(np.float32)
    start = rows[spans] * camera.width + begin

    best = np.zeros(camera.height * camera.width, dtype=np.uint64)
    total = np.cumsum(lengths)
    before = total - lengths
    low = 0
    while low < len(lengths):
        high = max(low + 1, int(np.searchsorted(total, before[low] + _CHUNK, side="right")))
        part, counts = slice(low, high), lengths[low:high]
        pixels = np.arange(before[low], total[high - 1], dtype=np.int64)
        steps = (pixels - np.repeat(before[part], counts)).astype(np.float32)
        pixels += np.repeat(start[part] - before[part], counts)
        near = np.repeat(left[part], counts) + np.repeat(across[part], counts) * steps
        # Positive floats are ordered as their bits are: the nearest span has the largest key.
        keys = near.view(np.uint32).astype(np.uint64) << np.uint64(32)
        keys |= np.repeat(np.arange(low + 1, high + 1, dtype=np.uint64), counts)
        np.maximum.at(best, pixels, keys)
        low = high
    (seen,) = np.nonzero(best)
    visible = np.full(len(best), -1, dtype=np.int64)
    depth = np.full(len(best), np.inf, dtype=np.float32)
    keys = best[seen]
    visible[seen] = owners[of][(keys & np.uint64(0xFFFFFFFF)).astype(np.int64) - 1]
    depth[seen] = np.float32(1.0) / (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)
    shape = (camera.height, camera.width)
    return visible.reshape(shape), depth.reshape(shape)


def _in_front(triangles: Array, near: float) -> tuple[Array, Index]:
    """The parts beyond the near plane of triangles that cross it, as triangles, and the index of each whole one."""
    inside = triangles[..., 2] > near
    count = inside.sum(axis=1)
    (one,), (two,) = (np.nonzero(count == number) for number in (1, 2))
    parts, owners = [np.empty((0, 3, 3))], [np.empty(0, dtype=np.int64)]
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
    share = (inside[:, 2] - near) / (inside[:, 2] - outside[:, 2])
    return inside + share[:, None] * (outside - inside)


def _pixels(places: Array, size: int) -> Index:
    """The first pixel whose centre is not before each place, from 0 to ``size``."""
    return np.ceil(np.clip(places, 0, size) - 0.5).astype(np.int64)


def _slope(x: Array, y: Array) -> Array:
    """Columns per row along edges (x, y), which do not go up."""
    return x / np.maximum(y, 1e-300)
