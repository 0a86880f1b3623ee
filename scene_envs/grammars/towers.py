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
        assets: asset names from the bottom up.
        where: the distribution of the axis, in the frame of the support.
        step: height (m) between the frames of neighbours; None stacks each on the top of the one below.
        yaw: how each object is turned.
        loads: what stands on the bottom object: surfaces, each with its towers.
        contents: assets inside the bottom object, which come to rest in it.
        filling: how the contents get there.
        beside: towers on the same support whose places are in the frame of the bottom object.

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
        """This tower and all that stand on it or beside it, recursively."""
        yield self
        for towers in (*(towers for _, towers in self.loads), self.beside):
            for tower in towers:
                yield from tower.walk()

    def moved(self, x: float, y: float, yaw: float) -> Tower:
        """The same tower in a frame that stands at (``x``, ``y``) m, turned by ``yaw`` rad."""
        return replace(self, where=Moved(self.where, x, y, yaw), yaw=self.yaw.turned(yaw))

    def count(self) -> int:
        """Objects in this tower, on it, in it and beside it."""
        return sum(len(tower.assets) + len(tower.contents) for tower in self.walk())


@dataclass(frozen=True)
class Surface:
    """A horizontal support of a grammar, with what stands on it.

    Attributes:
        children: what stands here; drawn and placed in this order.
        region: where children may stand.
        keep_out: per asset, radius (m) of a disc that no other keep-out may meet; by default the asset's plan.
        footprint: per asset, radius (m) of a disc that must lie wholly on the support; by default the asset's plan.
        height: z of the surface (m), in the world or in the frame of the object that carries it; None takes the
            height at which something rests in the middle of that object.
        layouts: how often the whole layout is tried before the structure is thrown away.
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
        """Draw towers; count in ``reasons`` why draws were thrown away."""


class Filling(Protocol):
    """Contents of a container, and their poses before they come to rest."""

    @property
    def node(self) -> Node:
        """Draws the contents; only their asset names count."""

    def start(self, container: Asset, contents: Sequence[Asset], rng: np.random.Generator) -> list[ContentPose]:
        """A pose for each of ``contents`` from which gravity takes it into the container."""
