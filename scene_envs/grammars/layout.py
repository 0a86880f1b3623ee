"""Layout of a structure: exact poses of towers on surfaces, surfaces on objects, contents at rest."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from scene_envs.grammars.containers import Containers
from scene_envs.grammars.plan import Disc, Plan, carrying_height, foot_of, plan_of, top_of
from scene_envs.grammars.surface import FreeSurface, Outline
from scene_envs.grammars.towers import Surface, Tower
from scene_envs.scene_types import SceneType

_SPOTS = 20
"""Places tried for an object with neighbours."""

Rotation = tuple[float, ...]
"""A rotation matrix, row-major."""


@dataclass(frozen=True)
class Frame:
    """An upright frame in the world: a place (m) and a yaw (rad)."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    yaw: float = 0.0

    def point(self, x: float, y: float) -> tuple[float, float]:
        """World (x, y) of a point of the frame."""
        if self.yaw == 0.0:
            return self.x + x, self.y + y
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y


@dataclass(frozen=True)
class Pose:
    """One placed object: asset name, translation (m) and rotation in the world."""

    asset: str
    translation: tuple[float, float, float]
    rotation: Rotation


class Layout:
    """Layout of structures of one scene type; failures are counted in ``reasons``."""

    def __init__(self, scene_type: SceneType, reasons: Counter[str]) -> None:
        self.library = scene_type.library
        self.reasons = reasons
        self.containers = Containers(scene_type)
        self._plans: dict[str, Plan] = {}
        self._outlines: dict[tuple[int, tuple[str, ...]], tuple[Surface, Outline]] = {}
        self._heights: dict[str, tuple[float, float, float]] = {}

    def place(
        self, surface: Surface, towers: Sequence[Tower], frame: Frame, carrier: str | None, rng: np.random.Generator
    ) -> list[Pose] | None:
        """Poses of the ``towers`` on ``surface`` and of everything on them, or None when they do not fit.

        ``frame`` is the frame of the ``carrier``, the asset that carries the surface; it is the world frame without
        a carrier.
        """
        if surface.height is not None:
            level = surface.height
        else:
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
                    self._note_failure(tower, towers[:count])
                return None
            poses += placed
        return poses

    def _note_failure(self, tower: Tower, standing: Sequence[Tower]) -> None:
        """Count that ``tower`` has no room, together with the most frequent asset on its surface."""
        name = tower.assets[0] if tower.assets else "what stands on a fixed object"
        others = Counter(other.assets[0] for other in standing if other.assets).most_common(1)
        where = f"beside {others[0][0]!r}" if others else "on its empty surface"
        self.reasons[f"no room for {name!r} {where}"] += 1

    def _add(
        self, free: FreeSurface, surface: Surface, tower: Tower, frame: Frame, height: float, rng: np.random.Generator
    ) -> list[Pose] | None:
        """One tower with everything on it, in it and next to it."""
        if not tower.assets:
            return self._loads(tower, replace(frame, z=height), None, rng)
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
        loads = self._loads(tower, frame, tower.assets[0], rng)
        contents = self._contents(tower, frame, rng) if tower.contents else []
        return None if loads is None or contents is None else poses + loads + contents

    def _loads(self, tower: Tower, frame: Frame, carrier: str | None, rng: np.random.Generator) -> list[Pose] | None:
        poses: list[Pose] = []
        for surface, towers in tower.loads:
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

    def _height(self, asset: str) -> tuple[float, float, float]:
        """z of the foot, of the top, and of an object at rest in the middle, m, asset frame."""
        if asset not in self._heights:
            model = self.library[asset]
            self._heights[asset] = foot_of(model), top_of(model), carrying_height(model)
        return self._heights[asset]

    def _plan(self, asset: str) -> Plan:
        if asset not in self._plans:
            self._plans[asset] = plan_of(self.library[asset])
        return self._plans[asset]

    def _outline(self, surface: Surface, assets: tuple[str, ...]) -> Outline:
        key = id(surface), assets
        if key not in self._outlines:
            bottom = assets[0]
            if bottom in surface.keep_out:
                keep_out: tuple[Plan, ...] = (Disc(surface.keep_out[bottom]),)
            else:
                keep_out = tuple(self._plan(asset) for asset in assets)
            if bottom in surface.footprint:
                footprint: tuple[Plan, ...] = (Disc(surface.footprint[bottom]),)
            else:
                footprint = tuple(self._plan(asset) for asset in assets)
            self._outlines[key] = surface, Outline(keep_out, footprint)  # keeps the surface, so its id stays unique
        return self._outlines[key][1]


def about_z(yaw: float) -> Rotation:
    """The rotation by ``yaw`` (rad) about the vertical."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return (cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
