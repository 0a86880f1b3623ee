"""A second opinion on what prompts claim, by other means than the code under test.

Sides come from a camera's view matrix, contacts from exact distances (FCL), containment from convex hulls, tables and
tiers from bounding boxes and heights.
"""

from __future__ import annotations

from functools import cache

import fcl
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scene_envs.assets import get_library
from scene_envs.datasets.prompts.claims import (
    Claim,
    NameCount,
    ObjectCount,
    PairCount,
    Place,
    PlaceCount,
    Reference,
    SideClaim,
    SupportCount,
)
from scene_envs.scene import SceneBatch

TIER_HEIGHTS = (0.4075, 0.1392, -0.1232, -0.3915)
"""Tiers of the shelf from the top, m."""
CONTACT = 0.01
CONTAINERS = ("bowl", "fruit_bowl", "utensil_crock", "mug", "teacup", "water_jug", "steamer_bottom")


class Oracle:
    """The first scene of a batch, seen through the scene type's camera."""

    def __init__(self, batch: SceneBatch) -> None:
        present = ~batch.is_empty[0].numpy()
        self.slots = np.flatnonzero(present)
        self.assets = batch.names()[0]
        self.names = [get_library([asset])[0].display_name for asset in self.assets]
        self.position = batch.translations[0].double().numpy()[present]
        self.rotation = batch.rotations[0].double().numpy()[present]
        self.corners = [
            hull(asset).points @ r.T + t for asset, r, t in zip(self.assets, self.rotation, self.position, strict=True)
        ]
        self.low = np.array([c.min(axis=0) for c in self.corners])
        self.high = np.array([c.max(axis=0) for c in self.corners])
        camera = batch.scene_type.camera
        self.view = view_matrix(np.array(camera.position), np.array(camera.target), np.array(camera.up))
        mass = np.array([get_library([asset])[0].center_of_mass for asset in self.assets])
        self.center = np.einsum("nij,nj->ni", self.rotation, mass) + self.position
        seen = np.c_[self.center, np.ones(len(self.center))] @ self.view.T  # x right, y up, z toward the camera
        looks_down = abs(self.view[2, 2]) > 0.7
        self.right, self.front = seen[:, 0], -seen[:, 1] if looks_down else seen[:, 2]

    def is_true(self, claim: Claim) -> bool:
        """Whether the claim holds in the scene."""
        match claim:
            case ObjectCount(number):
                return len(self.names) == number
            case NameCount(name, number):
                return self.names.count(name) == number
            case PlaceCount(name, number, place):
                return sum(self.is_at(i, place) for i in self.named(name)) == number
            case SupportCount(name, number, inside, landmark):
                holder = self.find(landmark)
                return sum(self.is_held(i, holder, inside) for i in self.named(name)) == number
            case PairCount(name, number, inside, under):
                holders = self.named(under)
                held = [any(self.is_held(i, j, inside) for j in holders if i != j) for i in self.named(name)]
                return sum(held) == number
            case SideClaim(subject, side, landmark):
                return self.is_aside(self.find(subject), side, self.find(landmark))

    def named(self, name: str) -> list[int]:
        return [i for i, other in enumerate(self.names) if other == name]

    def find(self, reference: Reference) -> int:
        """Index of the one thing meant."""
        members = [i for i in self.named(reference.name) if reference.place is None or self.is_at(i, reference.place)]
        if not reference.ordinal:
            (only,) = members
            return only
        key = {"left": self.right, "right": -self.right, "front": -self.front, "back": self.front}[reference.edge]
        return sorted(members, key=lambda i: key[i])[reference.ordinal - 1]

    def is_at(self, index: int, place: Place) -> bool:
        """Whether an object is above a table or inside a shelf, at the height of the tier."""
        unit = self.find(place.unit)
        x, y, _ = self.center[index]
        over = (self.low[unit, :2] <= (x, y)).all() and ((x, y) <= self.high[unit, :2]).all()
        if index == unit or not over:
            return False
        height = self.center[index, 2] - self.position[unit, 2]
        if place.tier is None:
            return height > 0
        above = [tier for tier, level in enumerate(TIER_HEIGHTS) if height >= level]
        return bool(above) and above[0] == place.tier % len(TIER_HEIGHTS)

    def is_held(self, upper: int, lower: int, inside: bool) -> bool:
        """Whether the lowest point of ``upper`` is deep in the hull of ``lower``, or they touch there."""
        corners = self.corners[upper]
        foot = corners[corners[:, 2] < corners[:, 2].min() + 1e-3].mean(axis=0)
        local = (foot - self.position[lower]) @ self.rotation[lower]
        equations = hull(self.assets[lower]).equations
        depth = -(equations[:, :3] @ local + equations[:, 3]).max()
        deep = self.assets[lower] in CONTAINERS and depth > 0 and self.high[lower, 2] - foot[2] > CONTACT
        if inside or deep:
            return bool(inside and deep)
        x, y = self.center[upper, :2]
        over = (self.low[lower, :2] <= (x, y)).all() and ((x, y) <= self.high[lower, :2]).all()
        higher = self.center[upper, 2] > self.center[lower, 2] and self.low[upper, 2] > self.low[lower, 2]
        return bool(over and higher and self.distance(upper, lower) <= CONTACT and self.is_highest(upper, lower))

    def is_highest(self, upper: int, lower: int) -> bool:
        """Whether nothing between the two, as a thin plate on a table, is what holds the upper one."""
        between = [
            i
            for i in range(len(self.names))
            if i not in (upper, lower) and self.low[lower, 2] < self.low[i, 2] < self.low[upper, 2]
        ]
        return not any(self.distance(upper, i) <= CONTACT and self.center[i, 2] > self.center[lower, 2]
                       and np.hypot(*(self.center[i] - self.center[upper])[:2]) < 0.05 for i in between)  # fmt: skip

    def is_aside(self, first: int, side: str, second: int) -> bool:
        right, front = self.right[first] - self.right[second], self.front[first] - self.front[second]
        if side == "next":
            gaps = np.maximum(self.low[first] - self.high[second], self.low[second] - self.high[first])
            tall = all(self.high[i, 2] - self.low[i, 2] > 0.5 for i in (first, second))
            return bool(gaps[2] < 0 and np.linalg.norm(np.maximum(gaps[:2], 0)) < (0.5 if tall else 0.05))
        ahead, across = {
            "left": (-right, front),
            "right": (right, front),
            "front": (front, right),
            "back": (-front, right),
        }[side]
        return bool(ahead > 0.02 and ahead >= abs(across))

    def distance(self, first: int, second: int) -> float:
        """Distance between the convex parts of two objects, m; 0 when they touch."""
        if (self.low[first] > self.high[second] + 0.05).any() or (self.low[second] > self.high[first] + 0.05).any():
            return np.inf
        least = np.inf
        for one in self.bodies(first):
            for other in self.bodies(second):
                least = min(least, max(0.0, fcl.distance(one, other, fcl.DistanceRequest(), fcl.DistanceResult())))
        return least

    def bodies(self, index: int) -> list[fcl.CollisionObject]:
        transform = fcl.Transform(self.rotation[index], self.position[index])
        return [fcl.CollisionObject(shape, transform) for shape in parts(self.assets[index])]


@cache
def hull(asset: str) -> ConvexHull:
    """The convex hull of an asset."""
    return ConvexHull(np.concatenate([part.vertices for part in get_library([asset])[0].fine]))


@cache
def parts(asset: str) -> list[fcl.Convex]:
    """FCL shapes of an asset's fine parts."""
    return [
        fcl.Convex(part.vertices, len(part.faces), np.c_[np.full(len(part.faces), 3), part.faces].ravel())
        for part in get_library([asset])[0].fine
    ]


def view_matrix(eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The usual look-at matrix: x right, y up, z toward the viewer."""
    z = (eye - target) / np.linalg.norm(eye - target)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix
