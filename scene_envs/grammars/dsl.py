"""Nodes of a grammar: objects, stacks, choices and repetitions, each of which draws towers.

A *tower* stands on a support. It is one object, or a stack of objects on the same vertical axis, with the objects on it
and in it. Nodes determine which objects there are (the structure). A distribution such as
:class:`~scene_envs.grammars.surface.Gaussian` determines where they are.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np

from scene_envs.errors import InvalidInputError
from scene_envs.grammars.layout import Filling, Node, Surface, Tower
from scene_envs.grammars.surface import Gaussian, PositionDistribution, Region, Yaw

_CENTER = Gaussian(along=0.0)


@dataclass(frozen=True)
class Object:
    """One object at a distribution of places, with the objects on it and in it.

    Attributes:
        asset: Asset name.
        where: Distribution of its place, in the frame of its support; the middle of the support by default.
        yaw: Distribution of its turn about the vertical; any angle by default.
        on: Surfaces that it carries, in its own frame: a shelf's tiers, the middle of a plate, the floor of a bowl.
        inside: Contents that come to rest in it under gravity: cutlery in a crock, fruit in a bowl.
        beside: Neighbours on the same support, at places in its frame: chairs around a table.
    """

    asset: str
    where: PositionDistribution = _CENTER
    yaw: Yaw = Yaw()  # noqa: RUF009  (frozen)
    on: Sequence[Surface] = ()
    inside: Filling | None = None
    beside: Node | None = None

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        loads = tuple((surface, surface.draw(rng, reasons)) for surface in self.on)
        contents: tuple[str, ...] = ()
        if self.inside is not None:
            contents = tuple(asset for tower in self.inside.node.draw(rng, reasons) for asset in tower.assets)
        beside = () if self.beside is None else tuple(self.beside.draw(rng, reasons))
        return [Tower((self.asset,), self.where, None, self.yaw, loads, contents, self.inside, beside)]


@dataclass(frozen=True)
class Tiers:
    """Several surfaces of the object that carries this node, such as the boards of a fixed shelf, drawn together."""

    surfaces: Sequence[Surface]

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        return [Tower((), _CENTER, loads=tuple((surface, surface.draw(rng, reasons)) for surface in self.surfaces))]


@dataclass(frozen=True)
class Cluster:
    """Nodes whose places are relative to one random place: the settings on two sides of a table.

    Attributes:
        member: Node at the common place.
        where: Distribution of the common place.
        yaw: Distribution of the common turn about the vertical; none by default.
    """

    member: Node
    where: PositionDistribution
    yaw: Yaw = Yaw(std=0.0)  # noqa: RUF009  (frozen)

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        (x, y), yaw = self.where.draw(rng), self.yaw.draw(rng)
        return [tower.moved(x, y, yaw) for tower in self.member.draw(rng, reasons)]


@dataclass(frozen=True)
class Stack:
    """A stack of random height: after each ``base``, one of ``then``.

    Attributes:
        base: Asset that carries others.
        then: Weights of the next level: ``base`` (go on), another asset (ends the stack), or None (ends it).
        step: Height (m) of each level; None puts each on the top of the one below.
        where: Distribution of the stack's axis; the middle of the support by default.
        at_most: Largest number of objects in the stack; a higher stack is drawn again.
        yaw: Distribution of the turn of each object; any angle by default.

    Raises:
        InvalidInputError: negative weights, or a stack that never ends.

    >>> Stack("box", {"box": 1.0})
    Traceback (most recent call last):
    scene_envs.errors.InvalidInputError: a Stack of 'box' needs at_most >= 1 and, in `then`, another asset or None ...
    """

    base: str
    then: Mapping[str | None, float]
    step: float | None = None
    where: PositionDistribution = _CENTER
    at_most: int = 10
    yaw: Yaw = Yaw()  # noqa: RUF009  (frozen)

    def __post_init__(self) -> None:
        _require_weights("Stack", self.then.values())
        if self.at_most < 1 or not any(weight for asset, weight in self.then.items() if asset != self.base):
            raise InvalidInputError(
                f"a Stack of {self.base!r} needs at_most >= 1 and, in `then`, another asset or None with a positive "
                f"weight, or it never ends; got at_most={self.at_most}, then={dict(self.then)}"
            )

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        options = list(self.then)
        while True:
            assets = [self.base]
            following: str | None = self.base
            while following == self.base and len(assets) <= self.at_most:
                following = options[_chosen(self.then.values(), rng)]
                if following is not None:
                    assets.append(following)
            if len(assets) <= self.at_most:
                return [Tower(tuple(assets), self.where, self.step, self.yaw)]
            reasons[f"stack of {self.base} above {self.at_most}"] += 1


@dataclass(frozen=True)
class Pile:
    """A pile whose members are drawn one by one from a mixture: board games, books, plates of several kinds.

    Attributes:
        members: (weight, asset) options for every level.
        height: Distribution of the number of objects.
        where: Distribution of the pile's axis; the middle of the support by default.
        yaw: Distribution of the turn of each object; any angle by default.
    """

    members: tuple[tuple[float, str], ...]
    height: Geometric
    where: PositionDistribution = _CENTER
    yaw: Yaw = Yaw()  # noqa: RUF009  (frozen)

    def __post_init__(self) -> None:
        _require_weights("Pile", [weight for weight, _ in self.members])

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        weights = [weight for weight, _ in self.members]
        assets = tuple(self.members[_chosen(weights, rng)][1] for _ in range(self.height.draw(rng)))
        return [Tower(assets, self.where, None, self.yaw)] if assets else []


@dataclass(frozen=True)
class Group:
    """All of several nodes, in order."""

    members: tuple[Node, ...]

    def __init__(self, *members: Node) -> None:
        object.__setattr__(self, "members", members)

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        return [tower for member in self.members for tower in member.draw(rng, reasons)]


NOTHING = Group()
"""No object at all, for use in a choice."""


@dataclass(frozen=True)
class OneOf:
    """Exactly one of several (weight, node) options; weights need not sum to one."""

    options: tuple[tuple[float, Node], ...]

    def __init__(self, *options: tuple[float, Node]) -> None:
        _require_weights("OneOf", [weight for weight, _ in options])
        object.__setattr__(self, "options", options)

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        return self.options[_chosen((weight for weight, _ in self.options), rng)][1].draw(rng, reasons)


@dataclass(frozen=True)
class Geometric:
    """P(n) proportional to (1 - p)^(n - low) for n = low..high; with chance 1 - ``present``, n = 0.

    >>> counts = [Geometric(0.5, 1, 2, present=0.9).draw(np.random.default_rng(seed)) for seed in range(200)]
    >>> sorted(set(counts))
    [0, 1, 2]
    >>> Geometric(0.5, 3, 1)
    Traceback (most recent call last):
    scene_envs.errors.InvalidInputError: Geometric needs p and present in [0, 1] and 0 <= low <= high, got p=0.5, ...

    Raises:
        InvalidInputError: p or ``present`` is outside [0, 1], or not 0 <= low <= high.
    """

    p: float
    low: int
    high: int
    present: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 <= self.p <= 1.0 and 0.0 <= self.present <= 1.0 and 0 <= self.low <= self.high):
            raise InvalidInputError(
                f"Geometric needs p and present in [0, 1] and 0 <= low <= high, "
                f"got p={self.p}, low={self.low}, high={self.high}, present={self.present}"
            )

    def draw(self, rng: np.random.Generator) -> int:
        """One count."""
        if rng.random() >= self.present:
            return 0
        return self.low + _chosen(((1.0 - self.p) ** n for n in range(self.high - self.low + 1)), rng)


@dataclass(frozen=True)
class Repeat:
    """A node several times, drawn again until every condition in ``such_that`` holds.

    Nodes are independent, so drawing this node again gives the same distribution as rejecting the whole scene.
    """

    node: Node
    count: Geometric
    such_that: Mapping[str, Callable[[Sequence[Tower]], bool]] = field(default_factory=dict)

    def draw(self, rng: np.random.Generator, reasons: Counter[str]) -> list[Tower]:
        for _ in range(100_000):
            towers = [tower for _ in range(self.count.draw(rng)) for tower in self.node.draw(rng, reasons)]
            failed = next((name for name, holds in self.such_that.items() if not holds(towers)), None)
            if failed is None:
                return towers
            reasons[failed] += 1
        raise InvalidInputError(f"a grammar's condition {failed!r} did not hold in 100,000 draws; it cannot be met")


def _chosen(weights: Iterable[float], rng: np.random.Generator) -> int:
    """The index of one of several ``weights``, drawn in proportion to them."""
    cumulative = list(accumulate(weights))
    return bisect_right(cumulative, rng.random() * cumulative[-1])


def _require_weights(word: str, weights: Collection[float]) -> None:
    if not all(weight >= 0 for weight in weights) or not sum(weights) > 0:
        raise InvalidInputError(f"{word} needs weights >= 0 with a positive sum, got {list(weights)}")


def maybe(chance: float, node: Node) -> Node:
    """A node with some chance, else nothing."""
    return OneOf((chance, node), (1.0 - chance, NOTHING))


def middle(child: Node) -> list[Surface]:
    """Something in the middle of a plate or on the floor of a bowl."""
    return [Surface([child], Region(0.01, 0.01), height=None)]


def toast(another: float) -> Node:
    """A slice of bread, with more on top by chance."""
    return Stack("bread_slice", {"bread_slice": another, None: 1.0 - another})


def at_least(objects: int) -> dict[str, Callable[[Sequence[Tower]], bool]]:
    """The condition that a scene has at least ``objects`` objects besides the fixed ones."""

    def enough(towers: Sequence[Tower]) -> bool:
        return sum(len(tower.assets) + len(tower.contents) for tower in towers) >= objects

    return {f"fewer than {objects} objects": enough}
