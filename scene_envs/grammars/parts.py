"""Parts that several scene types share: optional nodes, objects in the middle of others, conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from scene_envs.grammars.dsl import NOTHING, OneOf, Stack
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface, Tower


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
