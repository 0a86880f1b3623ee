"""Scenes for file formats: named objects with exact poses in double precision."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset
from scene_envs.rotations import matrix_to_quaternion, project_to_so3
from scene_envs.scene import SceneBatch, require_rigid_poses
from scene_envs.scene_types import SceneType


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """One object of a scene.

    Attributes:
        name: Unique name in the scene and identifier in every format, such as ``"teacup_0"``.
        asset: Asset of the object.
        slot: Row of the scene.
        category: Index of the asset in its scene type.
        translation: (3,) float64 m, world frame.
        rotation: (3, 3) float64, asset frame to world frame, orthonormal to machine precision.
        welded: Whether the object is fixed to the world.
    """

    name: str
    asset: Asset
    slot: int
    category: int
    translation: Array
    rotation: Array
    welded: bool

    @cached_property
    def quaternion(self) -> Array:
        """(4,) float64 unit quaternion (w, x, y, z) with w >= 0."""
        return quaternion(self.rotation)

    @cached_property
    def matrix(self) -> Array:
        """(4, 4) float64, asset frame to world frame."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation, self.translation
        return matrix


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """One scene.

    Attributes:
        index: Index in the batch.
        scene_type: Scene type of the scene.
        slots: Number of rows of the scene, empty ones included.
        objects: Objects in slot order.
    """

    index: int
    scene_type: SceneType
    slots: int
    objects: tuple[PlacedObject, ...]

    @property
    def assets(self) -> tuple[Asset, ...]:
        """The assets in use, each once, in category order."""
        used = {item.category: item.asset for item in self.objects}
        return tuple(used[category] for category in sorted(used))


def place(batch: SceneBatch) -> list[PlacedScene]:
    """The scenes of a batch with exact poses and unique names.

    Rotations in single precision become doubles on SO(3) that differ from the given ones by no more than their
    rounding. Objects are named after their asset and numbered in slot order. An asset without mass is welded.

    Raises:
        InvalidInputError: a pose is not finite, or a matrix is not a rotation; the message names its scene and slot.

    >>> scene = place(SceneBatch.empty("dimsum_table", 1))[0]
    >>> [(item.name, item.welded) for item in scene.objects]
    [('cafe_table_0', True)]
    """
    batch = batch.to("cpu")
    require_rigid_poses(batch)
    scene_type, library = batch.scene_type, batch.scene_type.library
    names = identifiers(library.names)
    translations = batch.translations.double().numpy()
    rotations = exact_rotations(batch.rotations.double().numpy())
    scenes = []
    for index, categories in enumerate(batch.categories.tolist()):
        seen: Counter[int] = Counter()
        objects = []
        for slot, category in enumerate(categories):
            if category == scene_type.num_assets:
                continue
            asset = library[category]
            objects.append(
                PlacedObject(
                    name=f"{names[asset.name]}_{seen[category]}",
                    asset=asset,
                    slot=slot,
                    category=category,
                    translation=translations[index, slot],
                    rotation=rotations[index, slot],
                    welded=category in scene_type.welded_categories or asset.static or asset.mass <= 0,
                )
            )
            seen[category] += 1
        scenes.append(PlacedScene(index, scene_type, len(categories), tuple(objects)))
    return scenes


def identifiers(names: Iterable[str]) -> dict[str, str]:
    """For each name, a unique identifier of letters, digits and underscores that does not start with a digit.

    >>> identifiers(["tea cup", "tea-cup", "7up", "plate"])
    {'tea cup': 'tea_cup', 'tea-cup': 'tea_cup_2', '7up': '_7up', 'plate': 'plate'}
    """
    found: dict[str, str] = {}
    for name in names:
        free, repeat = identifier(name), 1
        while free in found.values():
            repeat += 1
            free = f"{identifier(name)}_{repeat}"
        found[name] = free
    return found


def identifier(name: str) -> str:
    """``name`` with everything but letters, digits and underscores replaced; it does not start with a digit."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
    return f"_{plain}" if plain[0].isdigit() else plain


def exact_rotations(matrices: NDArray[np.floating]) -> Array:
    """Nearest rotations (..., 3, 3) in double precision, orthonormal to a few 1e-16.

    The SVD leaves an error of some 1e-16 per entry; one Newton step of the polar decomposition halves it.
    """
    rotation: Array = project_to_so3(torch.from_numpy(np.asarray(matrices, dtype=np.float64))).numpy()
    return rotation @ (1.5 * np.eye(3) - 0.5 * rotation.swapaxes(-1, -2) @ rotation)  # type: ignore[no-any-return]


def quaternion(rotation: Array) -> Array:
    """(4,) unit quaternion (w, x, y, z) of a rotation (3, 3), in double precision."""
    return matrix_to_quaternion(torch.from_numpy(np.asarray(rotation, dtype=np.float64))).numpy()  # type: ignore[no-any-return]


def angle_axis(rotation: Array) -> tuple[float, Array]:
    """Angle (degrees, 0..180) and unit axis (3,) of a rotation (3, 3).

    Unlike Euler angles, they are well defined at every rotation.

    >>> angle, axis = angle_axis(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    >>> round(angle, 12), axis.round(12).tolist()
    (90.0, [0.0, 1.0, 0.0])
    """
    w, *vector = quaternion(rotation).tolist()
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        return 0.0, np.array([0.0, 0.0, 1.0])
    return float(np.degrees(2.0 * np.arctan2(length, w))), np.array(vector) / length


def number(value: float) -> str:
    """The shortest text that reads back as exactly this double (17 digits at most).

    >>> number(0.1), number(-0.0), number(1 / 3)
    ('0.1', '0.0', '0.3333333333333333')
    """
    return repr(float(value) + 0.0)


def numbers(values: Sequence[float] | Array) -> str:
    """Several numbers as :func:`number` writes them, separated by spaces."""
    return " ".join(number(value) for value in np.asarray(values, dtype=np.float64).ravel())
