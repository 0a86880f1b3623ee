"""Contents of hollow objects: poses at rest in the frame of the container, from simulation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from scene_envs.grammars.plan import carrying_height, top_of
from scene_envs.grammars.towers import ContentPose, Filling, Node
from scene_envs.scene_types import Camera, FixedObject, SceneType

if TYPE_CHECKING:
    from scene_envs.assets.base import Asset
    from scene_envs.scene import SceneBatch

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
        floor, rim = carrying_height(container), top_of(container)
        phase = rng.random() * 2.0 * math.pi
        poses = []
        for index, asset in enumerate(contents):
            azimuth = phase + 2.0 * math.pi * (index + 0.3 * (rng.random() - 0.5)) / len(contents)
            low, high = asset.bounds
            across = 0.5 * float(high[1] - low[1])
            least = min(0.6 * self.radius, 0.012 * len(contents) / (2.0 * math.pi) + 0.004)
            foot = least + rng.random() * max(0.0, self.radius - across - 0.004 - least)
            lean = math.atan2(0.97 * self.radius - foot - 0.006, rim - floor)
            outward, tangent = (
                np.array([math.cos(azimuth), math.sin(azimuth), 0.0]),
                np.array([-math.sin(azimuth), math.cos(azimuth), 0.0]),
            )
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
                yaw = rng.random() * 2.0 * math.pi
                cos, sin = math.cos(yaw), math.sin(yaw)
                rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
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


class Containers:
    """Filled containers of one scene type."""

    def __init__(self, scene_type: SceneType) -> None:
        self._scene_type = scene_type
        self._settings: dict[str, SceneType] = {}

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

        scene_type = self._alone(container)
        translations = torch.zeros(1, len(contents) + 1, 3)
        rotations = torch.eye(3).expand(1, len(contents) + 1, 3, 3).clone()
        for slot, (rotation, translation) in enumerate(poses, start=1):
            rotations[0, slot] = torch.from_numpy(rotation)
            translations[0, slot] = torch.from_numpy(translation)
        names = scene_type.assets
        categories = torch.tensor([[names.index(container), *(names.index(name) for name in contents)]])
        return SceneBatch.from_parts(translations, rotations, categories, scene_type)

    def _alone(self, container: str) -> SceneType:
        """A scene type in which the container is welded to the origin."""
        if container not in self._settings:
            whole = self._scene_type
            self._settings[container] = SceneType(
                name=f"{whole.name}:{container}",
                assets=whole.assets,
                slots=whole.slots,
                workspace=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)),
                welded=(container,),
                fixed=(FixedObject(container),),
                camera=_NOWHERE,
                asset_folders=whole.asset_folders,
            )
        return self._settings[container]

    @staticmethod
    def _is_inside(container: Asset, assets: Sequence[Asset], batch: SceneBatch) -> bool:
        """Whether every centre of mass is above the bottom of the container's bounding box and between its sides."""
        low, high = container.bounds
        centers = np.stack([asset.center_of_mass for asset in assets])
        turned = np.einsum("nij,nj->ni", batch.rotations[0, 1:].double().numpy(), centers)
        points = turned + batch.translations[0, 1:].double().numpy()
        return bool(((points[:, :2] > low[:2]) & (points[:, :2] < high[:2])).all() and (points[:, 2] > low[2]).all())
