"""Supports of the objects of a batch: the object that each stands on or lies in, and its tier."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Generic, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_envs.arrays import constant_on
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
Column = TypeVar("Column", Tensor, NDArray[Any])
_ANGLES = torch.arange(8, dtype=torch.float64) * math.pi / 4.0
_DIRECTIONS = torch.stack([_ANGLES.cos(), _ANGLES.sin()], dim=1)  # (8, 2)


@lru_cache(maxsize=32)
def welded_mask(scene_type: SceneType) -> Tensor:
    """(C + 1,) bool: assets that are welded, and False for empty slots."""
    welded = torch.zeros(scene_type.num_assets + 1, dtype=torch.bool)
    welded[list(scene_type.welded_categories)] = True
    return welded


@dataclass(frozen=True, eq=False)
class Placed:
    """n objects of several scenes, one after the other, on the device of the scenes."""

    shape: torch.Size  # scenes, and their slots
    scene: Tensor  # (n,) index of the scene, ascending
    slot: Tensor  # (n,) slot in the scene, ascending within each
    category: Tensor  # (n,) index of the asset
    rotation: Tensor  # (n, 3, 3) rotation from the asset frame to the world
    translation: Tensor  # (n, 3) position of the asset frame, m
    center: Tensor  # (n, 3) centre of mass, world frame, m
    points: Tensor  # (n, 3, V) extreme points, world frame, m
    feet: Tensor  # (n, 9, 3) eight low points all round and their mean, m
    fixed: Tensor  # (n,) bool, static or welded

    @classmethod
    def of_scenes(
        cls, scene_type: SceneType, categories: Tensor, translations: Tensor, rotations: Tensor
    ) -> tuple[LibraryShapes, Placed]:
        """The shapes of the assets and the objects of B scenes, from categories (B, N), translations (B, N, 3) m and
        rotations (B, N, 3, 3).
        """
        shapes = library_shapes(scene_type.library, translations.device)
        scene, slot = torch.nonzero(categories != scene_type.num_assets, as_tuple=True)
        category = categories[scene, slot]
        translation, rotation = (poses[scene, slot].double() for poses in (translations, rotations))
        points = rotation @ shapes.points[category] + translation[..., None]
        center = (rotation @ shapes.center[category][..., None])[..., 0] + translation
        height = points[:, 2] - points[:, 2].amin(dim=-1, keepdim=True)
        outward = constant_on(_DIRECTIONS, points.device) @ points[:, :2] - _STEEPNESS * height[:, None]  # (n, 8, V)
        feet = points.gather(2, outward.argmax(dim=-1)[:, None].expand(-1, 3, -1)).mT
        feet = torch.cat([feet, feet.mean(dim=1, keepdim=True)], dim=1)
        fixed = shapes.static[category] | constant_on(welded_mask(scene_type), points.device)[category]
        return shapes, cls(categories.shape, scene, slot, category, rotation, translation, center, points, feet, fixed)

    def padded(self, values: Tensor, blank: float = 0) -> Tensor:
        """``values`` (n, ...) of the objects in their slots, (B, N, ...); others hold ``blank``, or -1 of integers."""
        blank = -1 if values.dtype == torch.int64 else blank
        return values.new_full((*self.shape, *values.shape[1:]), blank).index_put((self.scene, self.slot), values)

    def carried(self, support: Tensor) -> Tensor:
        """(B, N, N) bool: [i, j] whether object j is i, or is held by i, directly or not; ``support`` (n,) is slots."""
        carried = torch.eye(self.shape[1], dtype=torch.bool, device=support.device).repeat(self.shape[0], 1, 1)
        scene, upper, lower, below = self.scene, self.slot, support, self.padded(support)
        while len(held := torch.nonzero(lower >= 0)[:, 0]):
            scene, upper, lower = scene[held], upper[held], lower[held]
            carried[scene, lower, upper] = True
            lower = below[scene, lower]
        return carried


@dataclass(frozen=True, eq=False)
class Holding(Generic[Column]):
    """Supports of n objects; indices are into the same n."""

    support: Column  # (n,) object that each object stands on or lies in; -1 for none
    contained: Column  # (n,) bool; True where the object lies in its support
    inside: Column  # (n,) innermost container with the object in it or on top of its contents; -1 for none
    place: Column  # (n,) first fixed object down the chain of supports; -1 for none
    tier: Column  # (n,) tier of ``place``, counted from the top; -1 where ``place`` has none

    def counted(self: Holding[Tensor], numbers: Tensor) -> Holding[Tensor]:
        """The same with other indices: those of the objects are ``numbers`` (n,), such as their slots."""
        numbers = torch.cat([numbers, numbers.new_full((1,), -1)])  # index -1 stays
        return Holding(numbers[self.support], self.contained, numbers[self.inside], numbers[self.place], self.tier)


@dataclass(frozen=True, eq=False)
class Contacts:
    """M pairs of an object and another one that may hold it, with heights (m); :meth:`holding` applies a tolerance."""

    shapes: LibraryShapes
    objects: Placed
    upper: Tensor
    lower: Tensor
    gap: Tensor  # (M, 9) height of the feet above the upper side of the lower object
    tier: Tensor  # (M,) nearest tier from the top, -1 where there are none
    over: Tensor  # (M,) bool, the centre of mass is above the lower object
    above_rim: Tensor  # (M,) height of the mean foot above the rim of a container; inf where there is none
    above_well: Tensor  # (M,) height of the mean foot above the container's inside

    @classmethod
    def of(cls, shapes: LibraryShapes, objects: Placed) -> Contacts:
        """All pairs whose bounding boxes allow a contact."""
        upper, lower = _near_pairs(objects)
        category = objects.category[lower]

        def local(points: Tensor) -> Tensor:
            return (points - objects.translation[lower, None]) @ objects.rotation[lower]

        feet, center = local(objects.feet[upper]), local(objects.center[upper, None])[:, 0]
        gap = feet[..., 2] - shapes.wide[shapes.cells(category[:, None], feet)]
        tiers = shapes.tiers[category]
        levels = feet[..., 2, None] - tiers[:, None]  # (M, 9, L)
        nearest = levels[:, -1].abs().nan_to_num(torch.inf).argmin(dim=-1)
        on_level = levels.gather(2, nearest[:, None, None].expand(-1, levels.shape[1], 1))[..., 0]
        tiered = torch.isfinite(tiers[:, 0])
        gap = torch.where(tiered[:, None] & torch.isfinite(gap), on_level, gap)
        inside = shapes.top[shapes.cells(category, feet[:, -1])]
        return cls(
            shapes,
            objects,
            upper,
            lower,
            gap,
            torch.where(tiered, nearest, -1),
            shapes.covered[shapes.cells(category, center)],
            torch.where(torch.isfinite(inside), feet[:, -1, 2] - shapes.rim[category], torch.inf),
            feet[:, -1, 2] - inside,
        )

    def holding(self, tolerance: float | Tensor = CONTACT) -> Holding[Tensor]:
        """Supports of objects; surfaces touch when their gap or overlap is at most ``tolerance`` (m). Place and tier of
        an object that touches nothing are found with three times the tolerance.
        """
        support, contained, tier = self._lower(tolerance)
        far, _, far_tier = self._lower(_FAR * tolerance)
        loose = support < 0
        below, tier = torch.where(loose, far, support), torch.where(loose, far_tier, tier)
        fixed = torch.cat([self.objects.fixed, torch.ones_like(self.objects.fixed[:1])])  # index -1 ends every chain
        place, inside = below.clone(), torch.where(contained, support, -1)
        base = torch.arange(len(below), device=below.device)
        while len(going := torch.nonzero(~fixed[place])[:, 0]):
            base[going] = place[going]
            climbs = going[inside[going] < 0]
            inside[climbs] = torch.where(contained[place[climbs]], support[place[climbs]], -1)
            place[going] = below[place[going]]
        return Holding(support, contained, inside, place, torch.where(place >= 0, tier[base], -1))

    def _lower(self, tolerance: float | Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The highest object below each object, whether it contains the object, and the tier; (n,) each."""
        size = self.shapes.bounds[self.objects.category[self.lower]]
        into = (0.5 * (size[:, 1, 2] - size[:, 0, 2])).clamp(max=tolerance)
        touches = (self.gap <= tolerance) & (self.gap >= -into[:, None])  # (M, 9)
        inside = (self.above_rim <= -tolerance) & (self.above_well >= -tolerance)
        feet = self.objects.feet[self.upper, :, 2]
        height = torch.where(touches, feet - self.gap, -torch.inf).amax(dim=1)
        height = torch.where(inside, feet[:, -1] - self.above_well, height)
        height = torch.where((self.over & touches.any(dim=1)) | inside, height, -torch.inf)
        highest = height.new_full(self.objects.category.shape, -torch.inf).scatter_reduce(0, self.upper, height, "amax")
        held = (height == highest[self.upper]) & (height > -torch.inf)
        pair = torch.where(held, torch.arange(len(held), device=held.device), -1)  # of two as high, the last
        pair = torch.full_like(self.objects.category, -1).scatter_reduce(0, self.upper, pair, "amax")
        ends = (self.lower, -1), (inside, 0), (self.tier, -1)  # of objects without a pair
        lower, inside, tier = (torch.cat([side, side.new_full((1,), end)])[pair] for side, end in ends)
        return lower, inside, tier


def _near_pairs(objects: Placed) -> tuple[Tensor, Tensor]:
    """(upper, lower): pairs of one scene whose boxes allow that the first rests on or in the second."""

    padded = objects.padded
    low, high = (padded(side, torch.nan) for side in (objects.points.amin(dim=-1), objects.points.amax(dim=-1)))
    fixed, upright = padded(objects.fixed), padded(objects.rotation[:, 2, 2]) > _UPRIGHT
    a, b, top_a, top_b = low[:, :, None], low[:, None], high[:, :, None], high[:, None]
    near = (a[..., 2] <= top_b[..., 2] + _FAR * LARGEST_CONTACT) & (top_a[..., 2] > b[..., 2]) & upright[:, None]
    below = a[..., 2] > b[..., 2] + 1e-4  # so that no chain is a circle
    near &= torch.where(fixed[:, :, None] == fixed[:, None], below, fixed[:, None])
    for axis in (0, 1):
        near &= (a[..., axis] <= top_b[..., axis]) & (b[..., axis] <= top_a[..., axis])
    scene, first, second = torch.nonzero(near, as_tuple=True)
    number = padded(torch.arange(len(objects.scene), device=near.device))
    return number[scene, first], number[scene, second]
