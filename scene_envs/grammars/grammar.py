"""A grammar: a scene type's distribution over structures and exact poses, built without overlap."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError
from scene_envs.grammars.layout import Frame, Layout, Pose, Surface, Tower
from scene_envs.registry import Registry
from scene_envs.scene import POSE, POSE_FEATURES, SceneBatch
from scene_envs.scene_types import BUILT_IN, PLUGINS, SceneType, get_scene_type

_MAX_STRUCTURES = 10_000
"""Number of structures drawn for one scene before an error that the grammar is impossible."""
_MAX_WITHOUT_ROOM = 100
"""Structures in a row that may fail for lack of room."""


@dataclass
class Grammar:
    """A distribution over scenes of one type.

    Poses are exact: objects stand upright, and the objects of a tower share one axis. Only the contents of containers
    are settled in simulation.

    Attributes:
        name: Registered name.
        scene_type: Scene type, or its name.
        surfaces: Supports with their children.
        such_that: Named conditions on all towers of a scene, those on other towers included; a structure that fails
            one is rejected.
        reasons: Number of rejected draws by reason since the grammar was made.

    >>> from scene_envs.grammars import get_grammar
    >>> grammar = get_grammar("dimsum_table")
    >>> batch = grammar.sample(np.random.default_rng(0))
    >>> len(batch), bool(batch.counts >= 7)
    (1, True)
    """

    name: str
    scene_type: SceneType
    surfaces: Sequence[Surface]
    such_that: Mapping[str, Callable[[Sequence[Tower]], bool]] = field(default_factory=dict)
    reasons: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.scene_type = get_scene_type(self.scene_type)

    def sample(self, rng: np.random.Generator, count: int = 1) -> SceneBatch:
        """``count`` scenes as a batch."""
        return SceneBatch(torch.from_numpy(self.sample_array(rng, count)), self.scene_type)

    def sample_array(self, rng: np.random.Generator, count: int) -> NDArray[np.float32]:
        """(count, N, D) float32 raw scenes, not verified by physics; the fast bulk form of :meth:`sample`."""
        scenes = np.empty((count, *self._blank.shape), dtype=np.float32)
        for scene in scenes:
            self._fill(scene, rng)
        return scenes

    @cached_property
    def _blank(self) -> NDArray[np.float32]:
        return SceneBatch.empty(self.scene_type, 1).tensor[0].numpy().copy()

    @cached_property
    def _category(self) -> dict[str, int]:
        return {name: index for index, name in enumerate(self.scene_type.assets)}

    @cached_property
    def _layout(self) -> Layout:
        return Layout(self.scene_type, self.reasons)

    def _fill(self, scene: NDArray[np.float32], rng: np.random.Generator) -> None:
        """Write one scene into ``scene`` (N, D)."""
        structures = without_room = 0
        while structures < _MAX_STRUCTURES and without_room < _MAX_WITHOUT_ROOM:
            structures += 1
            towers = [surface.draw(rng, self.reasons) for surface in self.surfaces]
            if not self._accepts([part for row in towers for tower in row for part in tower.walk()]):
                continue
            poses = self._layout.place_all(zip(self.surfaces, towers, strict=True), Frame(), None, rng)
            if poses is not None:
                self._write(scene, poses)
                return
            without_room += 1
        raise InvalidInputError(
            f"grammar {self.name!r} made no scene in {structures} structures; "
            f"most frequent reasons: {', '.join(f'{why} ({count})' for why, count in self.reasons.most_common(3))}"
        )

    def _accepts(self, towers: Sequence[Tower]) -> bool:
        failed = next((name for name, holds in self.such_that.items() if not holds(towers)), None)
        objects = sum(len(tower.assets) + len(tower.contents) for tower in towers)
        if failed is None and objects + len(self.scene_type.fixed) > self.scene_type.slots:
            failed = f"more than {self.scene_type.slots} objects"
        if failed is not None:
            self.reasons[failed] += 1
        return failed is None

    def _write(self, scene: NDArray[np.float32], poses: Sequence[Pose]) -> None:
        scene[:] = self._blank
        for slot, pose in enumerate(poses, start=len(self.scene_type.fixed)):
            scene[slot, POSE] = (*pose.translation, *pose.rotation)
            scene[slot, -1] = 0.0
            scene[slot, POSE_FEATURES + self._category[pose.asset]] = 1.0


_FILES = {
    "breakfast_table_low_clutter": "breakfast",
    "breakfast_table_high_clutter": "breakfast",
    "living_room_shelf": "shelf",
    "pantry_shelf": "shelf",
    "restaurant_low_clutter": "restaurant",
    "restaurant_high_clutter": "restaurant",
}
"""Files of grammars that are not called like their scene type."""
GRAMMARS: Registry[Callable[[], Grammar]] = Registry(
    "grammar",
    PLUGINS,
    modules={built_in.name: f"scene_envs.grammars.{_FILES.get(built_in.name, built_in.name)}" for built_in in BUILT_IN},
)
"""Functions that make a grammar each, by name."""


def register_grammar(name: str) -> Callable[[Callable[[], Grammar]], Callable[[], Grammar]]:
    """Decorator: make the function's grammar available as ``name``; the same name again replaces it."""
    return GRAMMARS.adding(name)


def get_grammar(scene_type: str | SceneType | Grammar) -> Grammar:
    """A fresh grammar by its name; built-in ones are called like their scene type. Raises UnknownNameError."""
    if isinstance(scene_type, Grammar):
        return scene_type
    return GRAMMARS[scene_type.name if isinstance(scene_type, SceneType) else scene_type]()


def list_grammars() -> list[str]:
    """Names of all registered grammars, those of installed packages included, sorted."""
    return GRAMMARS.names()
