"""A scene type of boxes and a tray, whose physics has closed forms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from scene_envs.assets.base import Asset, AssetLibrary, ConvexPart
from scene_envs.assets.shapes import box, hull_of, mass_properties, ring, solid
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, FixedObject, SceneType, register_scene_type

SIDE = 0.1
"""Side of the box, m; its frame is the centre of its bottom face."""


def _asset(name: str, fine: Sequence[ConvexPart], coarse: Sequence[ConvexPart], mass: float) -> Asset:
    mass, center, inertia = mass_properties(fine, mass)
    return Asset(
        name=name, display_name=name, plural=name + "s", mass=mass, center_of_mass=center, inertia=inertia,
        visual=None, fine=tuple(fine), coarse=tuple(coarse), color=(0, 0, 0), static=mass == 0,
    )  # type: ignore[arg-type]  # fmt: skip


def _library() -> AssetLibrary:
    floor = [box((4.0, 4.0, 0.1), (0.0, 0.0, -0.1))]
    cube = [box((SIDE, SIDE, SIDE))]
    bowl = [*ring([(0.10, 0.0), (0.11, 0.0), (0.11, 0.1), (0.10, 0.1)], 12), solid([(0.10, 0.0), (0.10, 0.01)], 12)]
    post = [box((0.02, 0.02, 0.2))]
    return AssetLibrary(
        (
            _asset("floor", floor, floor, 0.0),
            _asset("cube", cube, cube, 0.5),
            _asset("bowl", bowl, [hull_of(bowl)], 0.4),
            _asset("post", post, post, 0.1),
        )
    )


def simple_type(slots: int = 24) -> SceneType:
    """The scene type, registered, with its library in place."""
    scene_type = SceneType(
        name=f"physics_test_{slots}",
        assets=("floor", "cube", "bowl", "post"),
        slots=slots,
        workspace=((-1.0, -1.0, -0.02), (1.0, 1.0, 2.0)),
        welded=("floor",),
        fixed=(FixedObject("floor"),),
        camera=Camera((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
    )
    scene_type.__dict__["library"] = _library()
    return register_scene_type(scene_type)


TYPE = simple_type()


def scene(*objects: tuple[str, float, float, float], yaw: float = 0.0, slots: int | None = None) -> SceneBatch:
    """One scene of the floor and upright objects at (x, y, z), all turned by ``yaw`` (rad)."""
    batch = SceneBatch.empty(TYPE, 1, slots)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    turn = torch.tensor(
        [[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]], dtype=torch.float32
    )
    for slot, (name, *position) in enumerate(objects, start=1):
        translations[0, slot] = torch.tensor(position)
        rotations[0, slot] = turn
        categories[0, slot] = TYPE.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, TYPE)


def turned(batch: SceneBatch, slot: int, rotation: np.ndarray) -> SceneBatch:
    """The same scene with another rotation (3, 3) in one slot."""
    rotations = batch.rotations.clone()
    rotations[:, slot] = torch.from_numpy(rotation).float()
    return batch.with_poses(batch.translations, rotations)
