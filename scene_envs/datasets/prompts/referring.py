"""Referring expressions: words that single out one object or one place of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from scene_envs.datasets.prompts.claims import Place, Reference
from scene_envs.datasets.prompts.facts import SIDES, SceneFacts

_LAST_ORDINAL = 5
"""The highest ordinal in use: "fifth"."""


@dataclass(frozen=True, eq=False)
class ReferringExpressions:
    """Expressions that single out the same object in every one of several views of a scene."""

    views: Sequence[SceneFacts]  # facts of one scene under several tolerances
    _known: dict[int, list[Reference]] = field(default_factory=dict, repr=False)

    @property
    def scene(self) -> SceneFacts:
        """Any view; names and positions are the same in all."""
        return self.views[0]

    def references(self, index: int) -> list[Reference]:
        """The simplest expressions for one object; empty when there are none.

        These are its name alone, or its name and place, or its rank counted from the sides where the rank is low.
        """
        if index not in self._known:
            self._known[index] = self._references(index)
        return self._known[index]

    def places(self, unit: int, tier: int) -> list[Place]:
        """Expressions for an object as a place, or for one of its tiers, counted from the nearer end."""
        tiers = int(self.scene.tiers[unit])
        if tiers and tier < 0:
            return []
        nearer = None if not tiers else tier if 2 * tier < tiers else tier - tiers
        return [Place(reference, nearer) for reference in self.references(unit) if reference.place is None]

    def _references(self, index: int) -> list[Reference]:
        scene = self.scene
        name = scene.names[index]
        if scene.objects[name] == 1:
            return [Reference(name)]
        places: list[Place | None] = [None]
        if not scene.fixed[index] and not self._share_place(name):
            unit, tier = int(scene.held.place[index]), int(scene.held.tier[index])
            places = [*self.places(unit, tier)] if unit >= 0 else []
        found = [Reference(name, place=place) for place in places if place is not None]
        clear = [reference for reference in found if self._is_clear(reference, index)]
        if clear:
            return clear
        ranked = [reference for place in places for reference in self._ranked(index, name, place)]
        return [reference for reference in ranked if self._is_clear(reference, index)]

    def _share_place(self, name: str) -> bool:
        """Whether all objects of that name are on one table, tier or floor."""
        members, held = self.scene.named(name), self.scene.held
        return len(set(zip(held.place[members].tolist(), held.tier[members].tolist(), strict=True))) == 1

    def _ranked(self, index: int, name: str, place: Place | None) -> list[Reference]:
        """References by rank, from the side where it is lowest, and from others where it is at most one higher."""
        members = self.scene.named(name)
        if place is not None:
            members = members[place.holds(self.scene)[members]]
        edges = SIDES[:2] if self.scene.held.tier[index] >= 0 else SIDES
        along = {edge: self.scene.along(edge) for edge in edges}
        ranks = {edge: 1 + int((along[edge][members] > along[edge][index]).sum()) for edge in edges}
        highest = min(1 + min(ranks.values()), _LAST_ORDINAL)
        return [Reference(name, rank, edge, place) for edge, rank in ranks.items() if rank <= highest]

    def _is_clear(self, reference: Reference, index: int) -> bool:
        return all(reference.resolve(view) == index for view in self.views)
