"""Drawn structures: towers, the surfaces they stand on, and the node protocol of grammars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from scene_envs.grammars.distributions import Moved, PositionDistribution, Yaw
from scene_envs.grammars.surface import Region

if TYPE_CHECKING:
    from scene_envs.assets.base import Asset

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

    def count(self) -> int:
        """Number of objects in this tower, on it, in it and next to it."""
        return sum(len(tower.assets) + len(tower.contents) for tower in self.walk())


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
