"""A grammar: a scene type's distribution over structures and exact poses, built without overlap."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.grammars.dsl import Node, Tower
from scene_envs.grammars.surface import FreeSurface, Region
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

_MAX_STRUCTURES = 10_000
"""Structures drawn for one scene before the grammar is called impossible."""
_MAX_WITHOUT_ROOM = 100
"""Structures in a row that may fail for lack of room."""


@dataclass(frozen=True)
class Surface:
    """A horizontal support of a grammar, with what stands on it.

    Attributes:
        children: what stands here; drawn and placed in this order.
        region: where children may stand.
        keep_out: per asset, the radius (m) no other child's keep-out circle may enter.
        footprint: per asset, the radius (m) that must lie wholly on the support.
        height: z of the surface, m, world frame.
        layouts: how often the whole layout is tried before the structure is thrown away.
    """

    children: Sequence[Node]
    region: Region
    keep_out: Mapping[str, float]
    footprint: Mapping[str, float]
    height: float = 0.0
    layouts: int = 10


@dataclass
class Grammar:
    """A distribution over scenes of one type. Poses are exact: yaw-only rotations, towers on one axis.

    Attributes:
        name: the registered name.
        scene_type: the scene type, or its name.
        surfaces: the supports with their children.
        such_that: named conditions on all towers of a scene; a structure that fails one is thrown away.
        reasons: how often, and why, draws were thrown away since the grammar was made.

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

    def _fill(self, scene: NDArray[np.float32], rng: np.random.Generator) -> None:
        """Write one scene into ``scene`` (N, D)."""
        structures = without_room = 0
        while structures < _MAX_STRUCTURES and without_room < _MAX_WITHOUT_ROOM:
            structures += 1
            nodes_of = [surface.children for surface in self.surfaces]
            towers = [[t for node in nodes for t in node.draw(rng, self.reasons)] for nodes in nodes_of]
            if not self._accepts([tower for surface_towers in towers for tower in surface_towers]):
                continue
            layout = [_layout(s, t, rng) for s, t in zip(self.surfaces, towers, strict=True)]
            if any(places is None for places in layout):
                self.reasons["no room"] += 1
                without_room += 1
                continue
            scene[:] = self._blank
            slot = len(self.scene_type.fixed)
            for surface, surface_towers, places in zip(self.surfaces, towers, layout, strict=True):
                for tower, (x, y) in zip(surface_towers, places or (), strict=True):
                    slot = self._write(scene, slot, tower, x, y, surface.height, rng)
            return
        raise InvalidInputError(
            f"grammar {self.name!r} made no scene in {structures} structures; "
            f"most frequent reasons: {dict(self.reasons.most_common(3))}"
        )

    def _accepts(self, towers: Sequence[Tower]) -> bool:
        failed = next((name for name, holds in self.such_that.items() if not holds(towers)), None)
        objects = sum(len(tower.assets) for tower in towers)
        if failed is None and objects + len(self.scene_type.fixed) > self.scene_type.slots:
            failed = f"more than {self.scene_type.slots} objects"
        if failed is not None:
            self.reasons[failed] += 1
        return failed is None

    def _write(
        self,
        scene: NDArray[np.float32],
        slot: int,
        tower: Tower,
        x: float,
        y: float,
        z: float,
        rng: np.random.Generator,
    ) -> int:
        for level, asset in enumerate(tower.assets):
            yaw = rng.random() * 2.0 * math.pi
            cos, sin = math.cos(yaw), math.sin(yaw)
            scene[slot, :12] = (x, y, z + level * tower.step, cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
            scene[slot, -1] = 0.0
            scene[slot, 12 + self._category[asset]] = 1.0
            slot += 1
        return slot


def _layout(surface: Surface, towers: Sequence[Tower], rng: np.random.Generator) -> list[tuple[float, float]] | None:
    """Positions of the towers' axes, (x, y) in m each; None when they do not fit."""
    for _ in range(surface.layouts):
        free = FreeSurface(surface.region)
        places: list[tuple[float, float]] = []
        for tower in towers:
            asset = tower.assets[0]
            spot = free.place(tower.where, surface.keep_out[asset], surface.footprint[asset], rng)
            if spot is None:
                break
            places.append(spot)
        else:
            return places
    return None


_REGISTRY: dict[str, Callable[[], Grammar]] = {}


def register_grammar(name: str) -> Callable[[Callable[[], Grammar]], Callable[[], Grammar]]:
    """Decorator: make the function's grammar available as ``name``; the same name again replaces it."""

    def register(make: Callable[[], Grammar]) -> Callable[[], Grammar]:
        _REGISTRY[name] = make
        return make

    return register


def get_grammar(scene_type: str | SceneType | Grammar) -> Grammar:
    """A fresh grammar by its name (built-in grammars are called like their scene type)."""
    if isinstance(scene_type, Grammar):
        return scene_type
    return grammar_factory(scene_type.name if isinstance(scene_type, SceneType) else scene_type)()


def grammar_factory(name: str) -> Callable[[], Grammar]:
    """The function registered as ``name``; raises UnknownNameError with the nearest known name."""
    if name not in _REGISTRY:
        raise unknown_name("grammar", name, _REGISTRY)
    return _REGISTRY[name]


def list_grammars() -> list[str]:
    """Names of all registered grammars, sorted."""
    return sorted(_REGISTRY)
