"""Layout of a structure: exact poses of towers on surfaces, surfaces on objects, contents at rest."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.grammars.surface import (
    Disc,
    FreeSurface,
    Moved,
    Outline,
    Plan,
    PositionDistribution,
    Region,
    Yaw,
    carrying_height,
    heights_of,
    plan_of,
)
from scene_envs.scene_types import Camera, FixedObject, SceneType

if TYPE_CHECKING:
    from scene_envs.assets.base import Asset
    from scene_envs.scene import SceneBatch


ContentPose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Rotation (3, 3) and translation (3,) m of an object in a container, in the container's frame."""


@dataclass(frozen=True)
class Tower:
    """Objects on one vertical axis, bottom first.

    Attributes:
        assets: Asset names from the bottom up.
        where: Distribution of the axis, in the frame of the support.
        step: Height (m) between the frames of neighbours; None stacks each on the top of the one below.
        yaw: Distribution of the turn of each object.
        loads: Surfaces on the bottom object, each with its towers.
        contents: Assets inside the bottom object, which come to rest in it.
        filling: Rule for the poses of the contents before they come to rest.
        beside: Towers on the same support whose places are in the frame of the bottom object.

    A tower without assets consists of its loads alone: surfaces in the frame of the object that carries the tower.
    """

    assets: tuple[str, ...]
    where: PositionDistribution
    step: float | None = None
    yaw: Yaw = Yaw()  # noqa: RUF009  (frozen)
    loads: tuple[tuple[Surface, tuple[Tower, ...]], ...] = ()
    contents: tuple[str, ...] = ()
    filling: Filling | None = None
    beside: tuple[Tower, ...] = ()

    def walk(self) -> Iterator[Tower]:
        """This tower and all towers on it or next to it, recursively."""
        yield self
        for towers in (*(towers for _, towers in self.loads), self.beside):
            for tower in towers:
                yield from tower.walk()

    def moved(self, x: float, y: float, yaw: float) -> Tower:
        """The same tower in a frame at (``x``, ``y``) m, turned by ``yaw`` rad."""
        return replace(self, where=Moved(self.where, x, y, yaw), yaw=self.yaw.turned(yaw))


@dataclass(frozen=True)
class Surface:
    """A horizontal support of a grammar, with its children.

    Attributes:
        children: Nodes on the support, drawn and placed in this order.
        region: Region of the children.
        keep_out: Radius (m) by asset of a disc that no other keep-out may meet; the asset's plan by default.
        footprint: Radius (m) by asset of a disc that must lie wholly on the support; the asset's plan by default.
        height: Height z of the surface (m), in the world or in the frame of the object that carries it; None takes the
            height at which an object rests in the middle of that object.
        layouts: Number of tries of the whole layout before the structure is rejected.
    """

    children: Sequence[Node]
    region: Region
    keep_out: Mapping[str, float] = field(default_factory=dict)
    footprint: Mapping[str, float] = field(default_factory=dict)
    height: float | None = 0.0
    layouts: int = 10

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> tuple[Tower, ...]:
        """The towers on this surface."""
        return tuple(tower for node in self.children for tower in node.draw(rng, reasons))


class Node(Protocol):
    """Anything that draws towers."""

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        """Draw towers, and count rejected draws by reason in ``reasons``."""


class Filling(Protocol):
    """Contents of a container, and their poses before they come to rest."""

    @property
    def node(self) -> Node:
        """Node that draws the contents; only their asset names count."""

    def start(self, container: Asset, contents: Sequence[Asset], rng: np.random.Generator) -> list[ContentPose]:
        """A start pose for each of ``contents``, from which it falls into the container."""


_SPOTS = 20
"""Places tried for an object with neighbours."""
_TRIES = 6
_SETTLE = 1.5
"""Time (s) in which contents come to rest."""
_NOWHERE = Camera((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))


@dataclass(frozen=True)
class Standing:
    """Long objects (long axis x, heavier end toward +x) that stand in a jar, heavier end up, leaning outward.

    Attributes:
        node: Node that draws the contents.
        radius: Inner radius of the jar, m.
    """

    node: Node
    radius: float

    def start(self, container: Asset, contents: Sequence[Asset], rng: np.random.Generator) -> list[ContentPose]:
        """Feet on a circle on the floor of the jar, shafts near its rim, all around."""
        _, rim, floor = heights_of(container)
        phase = rng.random() * 2.0 * math.pi
        poses = []
        for index, asset in enumerate(contents):
            azimuth = phase + 2.0 * math.pi * (index + 0.3 * (rng.random() - 0.5)) / len(contents)
            low, high = asset.bounds
            across = 0.5 * float(high[1] - low[1])
            least = min(0.6 * self.radius, 0.012 * len(contents) / (2.0 * math.pi) + 0.004)
            foot = least + rng.random() * max(0.0, self.radius - across - 0.004 - least)
            lean = math.atan2(0.97 * self.radius - foot - 0.006, rim - floor)
            outward = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            tangent = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
            shaft = math.sin(lean) * outward + math.cos(lean) * np.array([0.0, 0.0, 1.0])
            side = tangent if rng.random() < 0.5 else -tangent
            rotation = np.stack([shaft, side, np.cross(shaft, side)], axis=1)
            bottom = foot * outward + np.array([0.0, 0.0, floor + 0.004 + 0.5 * math.sin(abs(lean)) * across])
            poses.append((rotation, bottom - rotation @ np.array([low[0], 0.5 * (low[1] + high[1]), 0.0])))
        return poses


@dataclass(frozen=True)
class Heap:
    """Objects poured into a bowl one above the other, turned at random.

    Attributes:
        node: Node that draws the contents.
        radius: Largest distance (m) of the contents from the middle at the start.
        upright: Whether the vertical axis of each object is vertical at the start.
    """

    node: Node
    radius: float = 0.02
    upright: bool = False

    def start(self, container: Asset, contents: Sequence[Asset], rng: np.random.Generator) -> list[ContentPose]:
        """A column above the floor of the container."""
        z = carrying_height(container) + 0.002
        poses = []
        for asset in contents:
            if self.upright:
                rotation = np.array(about_z(rng.random() * 2.0 * math.pi)).reshape(3, 3)
            else:
                rotation, triangle = np.linalg.qr(rng.standard_normal((3, 3)))
                rotation = rotation * np.sign(np.diag(triangle))
                rotation[:, 0] *= np.linalg.det(rotation)
            corners = np.concatenate([part.vertices for part in asset.fine]) @ rotation.T
            low, high = corners.min(axis=0), corners.max(axis=0)
            angle, distance = rng.random() * 2.0 * math.pi, self.radius * math.sqrt(rng.random())
            center = 0.5 * (low + high)
            translation = np.array(
                [distance * math.cos(angle) - center[0], distance * math.sin(angle) - center[1], z - low[2]]
            )
            poses.append((rotation, translation))
            z += float(high[2] - low[2]) + 0.002
        return poses


@lru_cache(maxsize=64)
def _alone(whole: SceneType, container: str) -> SceneType:
    """A scene type in which the container is welded to the origin."""
    return SceneType(
        name=f"{whole.name}:{container}",
        assets=whole.assets,
        slots=whole.slots,
        workspace=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
        welded=(container,),
        fixed=(FixedObject(container),),
        camera=_NOWHERE,
        asset_folders=whole.asset_folders,
    )


class Containers:
    """Filled containers of one scene type."""

    def __init__(self, scene_type: SceneType) -> None:
        self._scene_type = scene_type

    def fill(
        self, container: str, contents: Sequence[str], filling: Filling, rng: np.random.Generator, reasons: Counter[str]
    ) -> list[ContentPose] | None:
        """Poses of the contents at rest in the container's frame; None when they do not stay in it."""
        from scene_envs.physics import feasibility, project, settle

        library = self._scene_type.library
        assets = [library[name] for name in contents]
        for _ in range(_TRIES):
            batch = project(self._batch(container, contents, filling.start(library[container], assets, rng))).batch
            settled = settle(batch, duration=_SETTLE)
            if bool(settled.valid[0]) and self._is_inside(library[container], assets, settled.batch):
                judged = feasibility(settled.batch, max_displacement=5e-3, max_rotation=math.inf, duration=0.25)
                if int(judged.counts[0]) == len(contents):
                    rotations = settled.batch.rotations[0, 1:].double().numpy()
                    translations = settled.batch.translations[0, 1:].double().numpy()
                    return list(zip(rotations, translations, strict=True))
            reasons[f"spilled from {container}"] += 1
        return None

    def _batch(self, container: str, contents: Sequence[str], poses: Sequence[ContentPose]) -> SceneBatch:
        from scene_envs.scene import SceneBatch

        scene_type = _alone(self._scene_type, container)
        translations = torch.zeros(1, len(contents) + 1, 3)
        rotations = torch.eye(3).expand(1, len(contents) + 1, 3, 3).clone()
        for slot, (rotation, translation) in enumerate(poses, start=1):
            rotations[0, slot] = torch.from_numpy(rotation)
            translations[0, slot] = torch.from_numpy(translation)
        names = scene_type.assets
        categories = torch.tensor([[names.index(container), *(names.index(name) for name in contents)]])
        return SceneBatch.from_parts(translations, rotations, categories, scene_type)

    @staticmethod
    def _is_inside(container: Asset, assets: Sequence[Asset], batch: SceneBatch) -> bool:
        """Whether every centre of mass is above the bottom of the container's bounding box and between its sides."""
        low, high = container.bounds
        centers = np.stack([asset.center_of_mass for asset in assets])
        turned = np.einsum("nij,nj->ni", batch.rotations[0, 1:].double().numpy(), centers)
        points = turned + batch.translations[0, 1:].double().numpy()
        return bool(((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all() and (points[:, 2] > low[2]).all())


@dataclass(frozen=True)
class Frame:
    """An upright frame in the world: a place (m) and a yaw (rad)."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0

    def point(self, x: float, y: float) -> tuple[float, float]:
        """World (x, y) of a point of the frame."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y


@dataclass(frozen=True)
class Pose:
    """One placed object: asset name, translation (m) and rotation in the world."""

    asset: str
    translation: tuple[float, float, float]
    rotation: tuple[float, ...]  # row-major


class Layout:
    """Layout of structures of one scene type; failures are counted in ``reasons``."""

    def __init__(self, scene_type: SceneType, reasons: Counter[str]) -> None:
        self.library = scene_type.library
        self.reasons = reasons
        self.containers = Containers(scene_type)
        self._outlines: dict[tuple[int, tuple[str, ...]], tuple[Surface, Outline]] = {}
        self._plan: Callable[[str], Plan] = cache(lambda asset: plan_of(self.library[asset]))
        self._height: Callable[[str], tuple[float, float, float]] = cache(lambda asset: heights_of(self.library[asset]))

    def place(
        self, surface: Surface, towers: Sequence[Tower], frame: Frame, carrier: str | None, rng: np.random.Generator
    ) -> list[Pose] | None:
        """Poses of the ``towers`` on ``surface`` and of everything on them, or None when they do not fit.

        ``frame`` is the frame of the ``carrier``, the asset that carries the surface; it is the world frame without
        a carrier.
        """
        level = surface.height
        if level is None:
            level = self._height(carrier)[2] if carrier is not None else 0.0
        for _ in range(surface.layouts):
            poses = self._try(surface, towers, frame, frame.z + level, rng)
            if poses is not None:
                return poses
        return None

    def _try(
        self, surface: Surface, towers: Sequence[Tower], frame: Frame, height: float, rng: np.random.Generator
    ) -> list[Pose] | None:
        free = FreeSurface(surface.region)
        poses: list[Pose] = []
        for count, tower in enumerate(towers):
            noted = self.reasons.total()
            placed = self._add(free, surface, tower, frame, height, rng)
            if placed is None:
                if self.reasons.total() == noted:  # no failure on it or in it was the cause
                    name = tower.assets[0] if tower.assets else "what stands on a fixed object"
                    others = Counter(other.assets[0] for other in towers[:count] if other.assets).most_common(1)
                    where = f"beside {others[0][0]!r}" if others else "on its empty surface"
                    self.reasons[f"no room for {name!r} {where}"] += 1
                return None
            poses += placed
        return poses

    def _add(
        self, free: FreeSurface, surface: Surface, tower: Tower, frame: Frame, height: float, rng: np.random.Generator
    ) -> list[Pose] | None:
        """One tower with everything on it, in it and next to it."""
        if not tower.assets:
            return self.place_all(tower.loads, replace(frame, z=height), None, rng)
        outline, mark = self._outline(surface, tower.assets), free.mark()
        for _ in range(_SPOTS if tower.beside else 1):
            spot = free.place(tower.where, tower.yaw, outline, rng, len(tower.assets))
            if spot is None:
                return None
            beside: list[Pose] = []
            for neighbor in tower.beside:
                near = neighbor.moved(spot[0], spot[1], spot[2][0])
                added = self._add(free, surface, near, frame, height, rng)
                if added is None:
                    break
                beside += added
            else:
                x, y = frame.point(spot[0], spot[1])
                own = self._tower(tower, x, y, height, [frame.yaw + yaw for yaw in spot[2]], rng)
                return None if own is None else own + beside
            free.reset(mark)
        return None

    def _tower(
        self, tower: Tower, x: float, y: float, height: float, yaws: Sequence[float], rng: np.random.Generator
    ) -> list[Pose] | None:
        poses = []
        z = base = height - self._height(tower.assets[0])[0]
        for level, (asset, yaw) in enumerate(zip(tower.assets, yaws, strict=True)):
            if level:
                below = tower.assets[level - 1]
                rise = self._height(below)[1] - self._height(asset)[0]
                z = z + rise if tower.step is None else base + level * tower.step
            poses.append(Pose(asset, (x, y, z), about_z(yaw)))
        frame = Frame(x, y, base, yaws[0])
        loads = self.place_all(tower.loads, frame, tower.assets[0], rng)
        contents = self._contents(tower, frame, rng) if tower.contents else []
        return None if loads is None or contents is None else poses + loads + contents

    def place_all(
        self,
        loads: Iterable[tuple[Surface, Sequence[Tower]]],
        frame: Frame,
        carrier: str | None,
        rng: np.random.Generator,
    ) -> list[Pose] | None:
        """The poses of :meth:`place` for several surfaces, each with its towers."""
        poses: list[Pose] = []
        for surface, towers in loads:
            placed = self.place(surface, towers, frame, carrier, rng)
            if placed is None:
                return None
            poses += placed
        return poses

    def _contents(self, tower: Tower, frame: Frame, rng: np.random.Generator) -> list[Pose] | None:
        assert tower.filling is not None
        filled = self.containers.fill(tower.assets[0], tower.contents, tower.filling, rng, self.reasons)
        if filled is None:
            return None
        turn = np.array(about_z(frame.yaw)).reshape(3, 3)
        poses = []
        for asset, (rotation, translation) in zip(tower.contents, filled, strict=True):
            x, y = frame.point(float(translation[0]), float(translation[1]))
            turned = tuple(float(value) for value in (turn @ rotation).ravel())
            poses.append(Pose(asset, (x, y, frame.z + float(translation[2])), turned))
        return poses

    def _outline(self, surface: Surface, assets: tuple[str, ...]) -> Outline:
        key = id(surface), assets
        if key not in self._outlines:
            keep_out, footprint = (
                (Disc(radii[assets[0]]),) if assets[0] in radii else tuple(self._plan(asset) for asset in assets)
                for radii in (surface.keep_out, surface.footprint)
            )
            self._outlines[key] = surface, Outline(keep_out, footprint)  # keeps the surface, so its id stays unique
        return self._outlines[key][1]


def about_z(yaw: float) -> tuple[float, ...]:
    """The rotation by ``yaw`` (rad) about the vertical, row-major."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
