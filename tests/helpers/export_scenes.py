"""Dimsum scenes whose poses and contacts are known, and what an export of them must come back as."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from scene_envs.export import PlacedScene, place
from scene_envs.physics import penetration
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

DIMSUM = get_scene_type("dimsum_table")
STEP = 0.091
"""Height of a steamer that another one stands on, m."""
LAID = [
    ("steamer_bottom", 0.0, 0.0, 0.0),
    ("steamer_bottom", 0.0, 0.0, STEP),
    ("steamer_lid", 0.0, 0.0, 2 * STEP),
    ("dinner_plate", 0.35, 0.05, 0.0),
    ("dinner_plate", -0.36, -0.05, 0.0),
    ("serving_dish", 0.05, -0.36, 0.0),
    ("teacup", 0.2, 0.28, 0.0),
    ("teacup", -0.2, 0.3, 0.0),
    ("teapot", 0.0, 0.3, 0.0),
]
"""(asset, x, y, z): a laid table on which everything stands exactly on what carries it."""


def make(translations: np.ndarray, rotations: np.ndarray, names: list[str], slots: int = 12) -> SceneBatch:
    """One scene of the table and the named objects at translations (n, 3), rotations (n, 3, 3)."""
    batch = SceneBatch.empty(DIMSUM, 1, slots)
    parts = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    for slot, name in enumerate(names, start=1):
        parts[0][0, slot] = torch.from_numpy(translations[slot - 1])
        parts[1][0, slot] = torch.from_numpy(rotations[slot - 1])
        parts[2][0, slot] = DIMSUM.assets.index(name)
    return SceneBatch.from_parts(*parts, DIMSUM)


def laid_scene() -> SceneBatch:
    """The laid table, each object turned about the vertical."""
    rng = np.random.default_rng(0)
    yaws = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (len(LAID), 1))).as_matrix()
    return make(np.array([row[1:] for row in LAID]), yaws, [row[0] for row in LAID])


def jittered_scene(seed: int) -> SceneBatch:
    """The laid table with every object moved by up to 3 cm and tilted a little: many overlap."""
    rng = np.random.default_rng(seed)
    translations = np.array([row[1:] for row in LAID]) + rng.uniform(-0.03, 0.03, (len(LAID), 3))
    rotations = Rotation.from_rotvec(rng.normal(0.0, 0.1, (len(LAID), 3))).as_matrix()
    return make(translations, rotations, [row[0] for row in LAID])


def tumbled_scene() -> SceneBatch:
    """Objects far apart in hard orientations: uniform ones, half turns, and pitch at and next to 90 degrees."""
    rng = np.random.default_rng(2)
    euler = [(0.3, 90.0, -0.7), (40.0, -90.0, 10.0), (10.0, 90.0 - 1e-5, 20.0), (180.0, 0.0, 0.0), (0.0, 0.0, 180.0)]
    hard = Rotation.from_euler("xyz", euler, degrees=True)
    rotations = Rotation.concatenate([hard, Rotation.random(6, rng=rng)]).as_matrix()
    translations = np.array([[0.3 * (i % 4), 0.3 * (i // 4), 0.3] for i in range(11)]) + rng.normal(0, 1e-3, (11, 3))
    return make(translations, rotations, ["teapot", "teacup", "steamer_lid", "dinner_plate"] * 2 + ["teacup"] * 3)


def all_scenes() -> SceneBatch:
    """A laid table, two jittered ones (no overlap near 1 mm, the limit of the verdict), and tumbled objects."""
    return SceneBatch.concatenate([laid_scene(), jittered_scene(3), jittered_scene(14), tumbled_scene()])


def deep_pairs(batch: SceneBatch, index: int, depth: float = 1e-3) -> set[frozenset[str]]:
    """Names of the object pairs of a scene that overlap deeper than ``depth`` m, by the project's own physics."""
    names = {thing.slot: thing.name for thing in place(batch)[index].objects}
    pairs = penetration(batch[index]).pairs[0]
    return {frozenset(names[slot] for slot in pair.slots) for pair in pairs if pair.depth > depth}


def pose_error(scene: PlacedScene, poses: dict[str, np.ndarray]) -> float:
    """Largest difference between any entry of the given poses (4, 4) and those of the scene; all must be there."""
    assert {thing.name for thing in scene.objects} <= set(poses)
    return max(float(np.abs(poses[thing.name] - thing.matrix).max()) for thing in scene.objects)


def moved(scene: PlacedScene, poses: dict[str, np.ndarray]) -> np.ndarray:
    """(2,): the largest displacement (m) and turn (rad) of any object from the scene to the given poses (4, 4)."""
    steps = [np.linalg.inv(thing.matrix) @ poses[thing.name] for thing in scene.objects]
    turns = Rotation.from_matrix([step[:3, :3] for step in steps]).magnitude()
    return np.array([max(np.linalg.norm(step[:3, 3]) for step in steps), turns.max()])


def transform(translation: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(4, 4) from (3,) and (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, 3], matrix[:3, :3] = translation, rotation
    return matrix
