"""Small grammars over a scene type of their own, quick enough to generate with physics in a test."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.datasets import GenerationReport, generate
from scene_envs.grammars import register_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, FixedObject, SceneType, register_scene_type

TYPE = register_scene_type(
    SceneType(
        name="toy_cups",
        assets=("cafe_table", "dinner_plate", "teacup"),
        slots=5,
        workspace=((-0.4, -0.4, -0.02), (0.4, 0.4, 0.5)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    )
)
CUPS_COUNT, CUPS_SHARD = 40, 15
"""Scenes of :func:`generate_cups`, and how many a shard holds: two whole ones and a part."""


@dataclass
class ToyGrammar:
    """Up to four cups on a table, 20 cm apart; one scene in four has two cups in one place.

    ``lean`` is the share of scenes whose last cup leans.
    """

    lean: float = 0.0
    name: str = "toy_cups"
    scene_type: SceneType = TYPE
    reasons: Counter[str] = field(default_factory=Counter)

    def sample_array(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        batch = SceneBatch.empty(TYPE, count)
        scenes = batch.tensor.numpy().copy()
        for scene in scenes:
            while rng.random() < 0.5:
                self.reasons["toy reason"] += 1
            cups = int(rng.integers(1, 5))
            places = rng.permutation([(x, y) for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2)])[:cups]
            places = places + rng.uniform(-0.02, 0.02, places.shape)
            if cups > 1 and rng.random() < 0.25:
                places[1] = places[0]
            for slot, (x, y) in enumerate(places, start=1):
                tilt = 0.3 if slot == cups and rng.random() < self.lean else 0.0
                scene[slot] = cup_row(x, y, rng.uniform(0, 2 * np.pi), tilt)
        return scenes


def cup_row(x: float, y: float, yaw: float = 0.0, tilt: float = 0.0) -> NDArray[np.float32]:
    """A slot (D,) with a cup that turns about z by ``yaw`` and leans by ``tilt``, rad."""
    cos, sin, up, side = np.cos(yaw), np.sin(yaw), np.cos(tilt), np.sin(tilt)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ np.array([[up, 0, side], [0, 1, 0], [-side, 0, up]])
    return np.array([x, y, 0.0, *turn.flatten(), 0, 0, 1, 0], dtype=np.float32)


@register_grammar("toy_cups")
def toy_cups() -> ToyGrammar:
    return ToyGrammar()


@register_grammar("toy_mortal")
def toy_mortal() -> ToyGrammar:
    """Toy cups, but the first worker that draws scene 10 of a shard dies; the flag file says that it happened."""
    return _Mortal()


class _Mortal(ToyGrammar):
    def sample_array(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        flag = Path(os.environ["SCENE_ENVS_TEST_FLAG"])
        sequence = rng.bit_generator.seed_seq.entropy
        if os.environ["SCENE_ENVS_TEST_PARENT"] != str(os.getpid()) and sequence[-1] == 10 and not flag.exists():
            flag.touch()
            os._exit(1)
        return super().sample_array(rng, count)


class _Hopeless(ToyGrammar):
    def sample_array(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        scenes = super().sample_array(rng, count)
        scenes[:, 1] = cup_row(3.0, 0.0)  # off the table
        return scenes


@register_grammar("toy_hopeless")
def toy_hopeless() -> ToyGrammar:
    return _Hopeless()


def toy_scenes(count: int, seed: int = 0) -> SceneBatch:
    """Scenes of the toy grammar, not verified."""
    return SceneBatch(torch.from_numpy(ToyGrammar().sample_array(np.random.default_rng(seed), count)), TYPE)


def generate_cups(
    output: Path, *, grammar: str = "toy_cups", count: int = CUPS_COUNT, workers: int = 0, **changes: Any
) -> GenerationReport:
    """A dataset of the toy grammar in ``output``, with other options than its own as keywords."""
    options = {"seed": 3, "shard_size": CUPS_SHARD, "progress": False} | changes
    return generate(grammar, count, output, workers=workers, **options)
