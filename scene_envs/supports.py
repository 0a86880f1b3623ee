"""Supports of the objects of a batch: the object that each stands on or lies in, and its tier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.assets.support_shapes import LibraryShapes, library_shapes
from scene_envs.scene_types import SceneType

CONTACT = 0.01
"""Largest gap or overlap (m) of surfaces that touch."""
LARGEST_CONTACT = 0.03
"""Largest allowed tolerance of contacts (m)."""
_FAR = 3.0
"""An object that touches nothing is still on a table or tier within this many times the tolerance."""
_UPRIGHT = 0.85
"""Cosine of the tilt up to which an object carries others."""
_STEEPNESS = 20.0
"""Weight of height in the choice of foot points: 1/20 m more height cancels 1 m more distance outward."""
_DIRECTIONS = np.stack([np.cos(np.arange(8) * np.pi / 4.0), np.sin(np.arange(8) * np.pi / 4.0)], axis=1)  # (8, 2)


@dataclass(frozen=True, eq=False)
class Placed:
    """n objects of several scenes, one after the other."""

    scene: Index  # (n,) index of the scene, ascending
    category: Index  # (n,) index of the asset
    rotation: Array  # (n, 3, 3) rotation from the asset frame to the world
    translation: Array  # (n, 3) position of the asset frame, m
    center: Array  # (n, 3) centre of mass, world frame, m
    points: Array  # (n, 3, V) extreme points, world frame, m
    feet: Array  # (n, 9, 3) eight low points all round and their mean, m
    fixed: Mask  # (n,) bool, static or welded

    @classmethod
    def of_scenes(
        cls, scene_type: SceneType, categories: Tensor, translations: Tensor, rotations: Tensor
    ) -> tuple[LibraryShapes, Placed, Index]:
        """The shapes of the assets, the objects of B scenes, and the slot of each object, from categories (B, N),
        translations (B, N, 3) m and rotations (B, N, 3, 3).
        """
        shapes = library_shapes(scene_type.library)
        scene, slot = np.nonzero((categories != scene_type.num_assets).cpu().numpy())
        category = categories.cpu().numpy()[scene, slot]
        translation, rotation = (poses.double().cpu().numpy()[scene, slot] for poses in (translations, rotations))
        points = rotation @ shapes.points[category] + translation[..., None]
        center = np.einsum("nij,nj->ni", rotation, shapes.center[category]) + translation
        height = points[:, 2] - points[:, 2].min(axis=-1, keepdims=True)
        outward = _DIRECTIONS @ points[:, :2] - _STEEPNESS * height[:, None]  # (n, 8, V)
        feet = np.take_along_axis(points, outward.argmax(axis=-1)[:, None], axis=-1).swapaxes(1, 2)
        feet = np.concatenate([feet, feet.mean(axis=1, keepdims=True)], axis=1)
        fixed = shapes.static[category] | np.isin(category, scene_type.welded_categories)
        return shapes, cls(scene, category, rotation, translation, center, points, feet, fixed), slot


@dataclass(frozen=True, eq=False)
class Holding:
    """Supports of n objects; indices are into the same n."""

    support: Index  # (n,) object that each object stands on or lies in; -1 for none
    contained: Mask  # (n,) bool; True where the object lies in its support
    inside: Index  # (n,) innermost container with the object in it or on top of its contents; -1 for none
    place: Index  # (n,) first fixed object down the chain of supports; -1 for none
    tier: Index  # (n,) tier of ``place``, counted from the top; -1 where ``place`` has none

    def part(self, rows: slice) -> Holding:
        """Supports of the objects of ``rows``, which are whole scenes; indices count from their first object."""
        pointers = (np.maximum(column[rows] - rows.start, -1) for column in (self.support, self.inside, self.place))
        support, inside, place = pointers
        return Holding(support, self.contained[rows], inside, place, self.tier[rows])

    def carries(self) -> Mask:
        """(n, n) bool: whether each object carries each other one, directly or through others."""
        found = np.zeros((len(self.support), len(self.support)), dtype=bool)
        below, upper = self.support, np.arange(len(self.support))
        while len(upper := upper[below[upper] >= 0]):
            found[below[upper], upper] = True
            below = np.where(below >= 0, self.support[below], -1)
        return found


@dataclass(frozen=True, eq=False)
class Contacts:
    """M pairs of an object and another one that may hold it, with heights (m); :meth:`holding` applies a tolerance."""

    shapes: LibraryShapes
    objects: Placed
    upper: Index
    lower: Index
    gap: Array  # (M, 9) height of the feet above the upper side of the lower object
    tier: Index  # (M,) nearest tier from the top, -1 where there are none
    over: Mask  # (M,) the centre of mass is above the lower object
    above_rim: Array  # (M,) height of the mean foot above the rim of a container; inf where there is none
    above_well: Array  # (M,) height of the mean foot above the container's inside

    @classmethod
    def of(cls, shapes: LibraryShapes, objects: Placed) -> Contacts:
        """All pairs whose bounding boxes allow a contact."""
        upper, lower = _near_pairs(objects)
        category = objects.category[lower]

        def local(points: Array) -> Array:
            offset = points - objects.translation[lower].reshape(len(lower), *(1,) * (points.ndim - 2), 3)
            return np.einsum("m...i,mij->m...j", offset, objects.rotation[lower])

        feet, center = local(objects.feet[upper]), local(objects.center[upper])
        many = np.broadcast_to(category[:, None], feet.shape[:2])
        gap = feet[..., 2] - shapes.wide[shapes.cells(many, feet)]
        tier = np.full(len(upper), -1)
        tiered = np.isfinite(shapes.tiers[category, 0])
        if tiered.any():
            levels = feet[tiered, :, 2, None] - shapes.tiers[category[tiered], None, :]  # (T, 9, L)
            nearest = np.nanargmin(np.abs(levels[:, -1]), axis=-1)
            tier[tiered] = nearest
            on_level = np.take_along_axis(levels, nearest[:, None, None], axis=-1)[..., 0]
            gap[tiered] = np.where(np.isfinite(gap[tiered]), on_level, np.inf)
        inside = shapes.top[shapes.cells(category, feet[:, -1])]
        return cls(
            shapes,
            objects,
            upper,
            lower,
            gap,
            tier,
            shapes.covered[shapes.cells(category, center)],
            np.where(np.isfinite(inside), feet[:, -1, 2] - shapes.rim[category], np.inf),
            feet[:, -1, 2] - inside,
        )

    def holding(self, tolerance: float = CONTACT) -> Holding:
        """Supports of objects; surfaces touch when their gap or overlap is at most ``tolerance`` (m). Place and tier of
        an object that touches nothing are found with three times the tolerance.
        """
        support, contained, tier = self._lower(tolerance)
        far, _, far_tier = self._lower(_FAR * tolerance)
        loose = support < 0
        below, tier = np.where(loose, far, support), np.where(loose, far_tier, tier)
        fixed = np.append(self.objects.fixed, True)  # index -1 ends every chain
        place, inside, base = below.copy(), np.where(contained, support, -1), np.arange(len(below))
        while (going := np.flatnonzero(~fixed[place])).size:
            base[going] = place[going]
            climbs = going[inside[going] < 0]
            inside[climbs] = np.where(contained[place[climbs]], support[place[climbs]], -1)
            place[going] = below[place[going]]
        return Holding(support, contained, inside, place, np.where(place >= 0, tier[base], -1))

    def _lower(self, tolerance: float) -> tuple[Index, Mask, Index]:
        """The highest object below each object, whether it contains the object, and the tier; (n,) each."""
        size = self.shapes.bounds[self.objects.category[self.lower]]
        thickness = size[:, 1, 2] - size[:, 0, 2]
        into = np.minimum(tolerance, 0.5 * thickness)
        touches = (self.gap <= tolerance) & (self.gap >= -into[:, None])  # (M, 9)
        inside = (self.above_rim <= -tolerance) & (self.above_well >= -tolerance)
        height = np.where(touches, self.objects.feet[self.upper, :, 2] - self.gap, -np.inf).max(axis=1)
        height = np.where(inside, self.objects.feet[self.upper, -1, 2] - self.above_well, height)
        held = np.flatnonzero((self.over & touches.any(axis=1)) | inside)
        held = held[np.argsort(height[held], kind="stable")]  # later, higher ones overwrite
        count = len(self.objects.category)
        support, contained, tier = np.full(count, -1), np.zeros(count, dtype=bool), np.full(count, -1)
        support[self.upper[held]] = self.lower[held]
        contained[self.upper[held]] = inside[held]
        tier[self.upper[held]] = self.tier[held]
        return support, contained, tier


def _near_pairs(objects: Placed) -> tuple[Index, Index]:
    """(upper, lower): pairs of one scene whose boxes allow that the first rests on or in the second."""
    low, high = objects.points.min(axis=-1), objects.points.max(axis=-1)
    uppers, lowers = [], []
    starts = np.flatnonzero(np.diff(objects.scene, prepend=-1))
    for start, stop in zip(starts, np.append(starts[1:], len(objects.scene)), strict=True):
        a, b = low[start:stop, None], low[None, start:stop]
        top_a, top_b = high[start:stop, None], high[None, start:stop]
        near = (a[..., 2] <= top_b[..., 2] + _FAR * LARGEST_CONTACT) & (top_a[..., 2] > b[..., 2])
        fixed_a, fixed_b = objects.fixed[start:stop, None], objects.fixed[None, start:stop]
        near &= np.where(fixed_a == fixed_b, a[..., 2] > b[..., 2] + 1e-4, fixed_b)  # so that no chain is a circle
        near &= (a[..., 0] <= top_b[..., 0]) & (b[..., 0] <= top_a[..., 0])
        near &= (a[..., 1] <= top_b[..., 1]) & (b[..., 1] <= top_a[..., 1])
        near &= objects.rotation[None, start:stop, 2, 2] > _UPRIGHT
        np.fill_diagonal(near, False)
        first, second = np.nonzero(near)
        uppers.append(first + start)
        lowers.append(second + start)
    return np.concatenate([*uppers, np.empty(0, dtype=np.int64)]), np.concatenate([*lowers, np.empty(0, np.int64)])
