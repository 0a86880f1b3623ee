"""Scenes as lists of named poses, and checks that hold for every scene type; shared by the tests of grammars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from scene_envs.datasets.generation import judge_scenes
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.layout import Containers
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Thing:
    """One object of a scene: name, translation (3,) m and rotation (3, 3)."""

    name: str
    at: Array
    rotation: Array


def things_of(scenes: NDArray[np.float32], scene_type: SceneType) -> list[list[Thing]]:
    """The objects of each scene (count, N, D), in slot order, welded ones first."""
    return [
        [
            Thing(
                scene_type.assets[int(row[12:-1].argmax())],
                row[:3].astype(float),
                row[3:12].reshape(3, 3).astype(float),
            )
            for row in scene
            if row[-1] == 0
        ]
        for scene in scenes
    ]


def every(scenes: list[list[Thing]], *names: str) -> Iterator[tuple[Thing, list[Thing]]]:
    """Each object with one of these names, and the scene it is in."""
    for scene in scenes:
        for thing in scene:
            if thing.name in names:
                yield thing, scene


def apart(first: Thing, second: Thing) -> float:
    """Distance (m) in the plane."""
    return float(np.hypot(*(first.at - second.at)[:2]))


def counts(grammar: Grammar, count: int, seed: int = 0) -> NDArray[np.int64]:
    """(count,) objects per scene, from scenes whose containers' contents are drawn but not settled."""

    def not_settled(self: Containers, container: str, contents: list[str], *_: object) -> list[tuple[Array, Array]]:
        return [(np.eye(3), np.zeros(3))] * len(contents)

    with patch.object(Containers, "fill", not_settled):
        scenes = grammar.sample_array(np.random.default_rng(seed), count)
    number: NDArray[np.int64] = (scenes[..., -1] == 0).sum(axis=1)
    return number


def check_slots(scenes: NDArray[np.float32], scene_type: SceneType) -> None:
    """The welded support is in slot 0, empty slots come last and are zero, rotations are rotations."""
    support = scene_type.fixed[0].asset
    assert (scenes[:, 0, 12 + scene_type.assets.index(support)] == 1).all()
    assert (scenes[:, 0, :12] == np.r_[0, 0, 0, np.eye(3).ravel()]).all()
    assert (scenes[..., 12:].sum(axis=-1) == 1).all()
    empty = scenes[..., -1] == 1
    assert (np.diff(empty.astype(int), axis=1) >= 0).all()
    assert (scenes[empty][:, :-1] == 0).all()
    rotations = scenes[~empty][:, 3:12].reshape(-1, 3, 3).astype(float)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotations), 1, 1)),
                               atol=1e-5)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)


def check_physics(scenes: NDArray[np.float32], scene_type: SceneType) -> None:
    """Inside the workspace, no pair deeper than 1 mm, nothing moves by 1 cm in half a second."""
    import torch

    assert set(judge_scenes(SceneBatch(torch.from_numpy(scenes), scene_type))) == {""}


def contents_of(container: Thing, scene: list[Thing], scene_type: SceneType) -> list[Thing]:
    """What has its centre of mass above the floor of a hollow thing, within its outline and 5 cm above its rim."""
    low, high = scene_type.library[container.name].bounds

    def is_inside(thing: Thing) -> bool:
        asset = scene_type.library[thing.name]
        center = container.rotation.T @ (thing.rotation @ asset.center_of_mass + thing.at - container.at)
        return bool(np.hypot(center[0], center[1]) < high[0] and low[2] < center[2] < high[2] + 0.05)

    return [thing for thing in scene if thing is not container and is_inside(thing)]


def check_support(scene: list[Thing], scene_type: SceneType, levels: tuple[float, ...]) -> None:
    """Every object stands upright on a level (m) or in the middle of something else, or lies in a bowl or crock."""
    library = scene_type.library
    hollow = [thing for thing in scene if thing.name in ("bowl", "fruit_bowl", "utensil_crock")]
    contained = {id(thing) for bowl in hollow for thing in contents_of(bowl, scene, scene_type)}
    for thing in scene[1:]:
        if id(thing) in contained:
            continue
        assert thing.rotation[2, 2] == 1.0, thing
        if min(abs(thing.at[2] - level) for level in levels) < 1e-6:
            continue
        below = [other for other in scene[1:] if other.at[2] < thing.at[2] - 1e-6 and apart(thing, other) < 0.02]
        heights = [other.at[2] + height for other in below for height in (library[other.name].bounds[1, 2], 0.006)]
        assert min((abs(thing.at[2] - height) for height in heights), default=np.inf) < 1e-6, thing


def check_reproducible(name: str) -> None:
    """A seed gives the same scenes again, and another seed gives others."""
    first, again, other = (get_grammar(name).sample_array(np.random.default_rng(seed), 1) for seed in (4, 4, 5))
    assert (first == again).all()
    assert not (first == other).all()
