"""Writer of prompts: chooses facts of a scene and phrases them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from scene_envs.datasets.prompts.claims import (
    Claim,
    NameCount,
    ObjectCount,
    PairCount,
    Place,
    PlaceCount,
    Reference,
    Side,
    SideClaim,
    SupportCount,
)
from scene_envs.datasets.prompts.facts import LOOSE, NOMINAL, SIDES, STRICT, SceneFacts, facts_under
from scene_envs.datasets.prompts.parser import Nouns
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

_LAST_ORDINAL = 5
"""The highest ordinal in use: "fifth"."""


_T = TypeVar("_T")

KINDS = ("count", "names", "relations")
"""The kinds of prompts."""

_MAX_NAMES = 10
"""Largest number of names in one prompt."""
_MAX_RELATIONS = 3
"""Largest number of relations in one prompt."""
_TRIES = 8
"""Draws for each relation, and for a prompt that differs from the others of its scene."""


def describe(batch: SceneBatch, rng: np.random.Generator, *, kinds: Sequence[str] = KINDS) -> list[str]:
    """One prompt per scene, of a random kind; a count where the scene has no claims of that kind.

    Raises:
        InvalidInputError: an unknown kind.
    """
    unknown = sorted(set(kinds) - set(KINDS))
    if unknown or not kinds:
        raise InvalidInputError(f"unknown kinds of prompts {unknown}; choose from {list(KINDS)}")
    return [writer.write(kinds[int(rng.integers(len(kinds)))]) for writer in _writers(batch, rng)]


def describe_all(batch: SceneBatch, rng: np.random.Generator, *, count: int = 3) -> list[tuple[str, ...]]:
    """``count`` prompts per scene, of different kinds and without duplicates where the scene has enough claims.

    Raises:
        InvalidInputError: ``count`` is not positive.
    """
    if count < 1:
        raise InvalidInputError(f"count must be at least 1 prompt per scene, got {count}")
    return [writer.write_all(count) for writer in _writers(batch, rng)]


def _writers(batch: SceneBatch, rng: np.random.Generator) -> list[_Writer]:
    nouns = Nouns(batch.scene_type)
    views = zip(*facts_under(batch, [STRICT, NOMINAL, LOOSE]), strict=True)
    return [_Writer(scene, nouns, rng) for scene in views]


@dataclass(frozen=True, eq=False)
class _Writer:
    """Writer of prompts about one scene, with its facts under strict, nominal and loose tolerances."""

    views: tuple[SceneFacts, ...]
    nouns: Nouns
    rng: np.random.Generator
    _known: dict[int, list[Reference]] = field(default_factory=dict)

    @property
    def scene(self) -> SceneFacts:
        """The facts of the scene under the tolerances with which prompts are checked."""
        return self.views[1]

    def write(self, kind: str) -> str:
        """A prompt of ``kind``, or a count when the scene has no claims of that kind."""
        claims: list[Claim] = []
        if kind == "names":
            claims = [NameCount(name, self.scene.objects[name]) for name in self._names()]
        elif kind == "relations":
            claims = self._relations()
        return self.nouns.sentence(claims or [ObjectCount(self.scene.count)])

    def write_all(self, count: int) -> tuple[str, ...]:
        """One prompt of each kind in turn; further ones are names and relations."""
        prompts: list[str] = []
        for turn in range(count):
            wanted = KINDS[turn] if turn < len(KINDS) else KINDS[1 + turn % 2]
            for attempt in range(_TRIES):
                prompt = self.write(wanted if attempt < _TRIES // 2 else "names")
                if prompt not in prompts:
                    break
            prompts.append(prompt)
        return tuple(prompts)

    def _names(self) -> list[str]:
        """Display names in random order, at most ten: all or some with even chance, but not furniture alone."""
        names = sorted(self.scene.objects)
        whole = self.rng.random() < 0.5
        size = len(names) if whole or len(names) < 2 else int(self.rng.integers(1, len(names) + 1))
        chosen = [names[i] for i in self.rng.permutation(len(names))[: min(size, _MAX_NAMES)]]
        free = sorted({self.scene.names[i] for i in np.flatnonzero(~self.scene.fixed)})
        return chosen if set(free) & set(chosen) or not free else [*chosen[1:], self._pick(free)]

    def _relations(self) -> list[Claim]:
        """Up to three relations of families drawn with equal chances, each true under every tolerance."""
        families: list[Callable[[], Claim | None]] = []
        families += [self._pair] if self._pairs else []
        families += [self._hold] if self._holds else []
        families += [self._stay] if self._stays else []
        families += [self._aside] if len(self._neighbors) else []
        claims: dict[Hashable, Claim] = {}
        wanted = int(self.rng.integers(1, _MAX_RELATIONS + 1)) if families else 0
        for _ in range(_TRIES * (wanted + 2)):
            if len(claims) == wanted:
                break
            claim = self._pick(families)()
            if claim is not None and self._topic(claim) not in claims and self._is_clear(claim):
                claims[self._topic(claim)] = claim
        return list(claims.values())

    def _topic(self, claim: Claim) -> Hashable:
        """The objects of a relation; a prompt has at most one relation about the same objects."""
        match claim:
            case PairCount(name, _, _, under):
                return name, under
            case SupportCount(name, _, _, landmark):
                return name, landmark.name
            case SideClaim(subject, _, landmark):
                return frozenset((subject.resolve(self.scene), landmark.resolve(self.scene)))
        return claim

    def _is_clear(self, claim: Claim) -> bool:
        return all(claim.check(view).holds for view in self.views)

    @cached_property
    def _holds(self) -> Counter[tuple[str, bool, int]]:
        """Number of pairs by (upper name, inside, index of a free lower object)."""
        scene, holds = self.scene, Counter[tuple[str, bool, int]]()
        for upper, lower in enumerate(scene.held.support):
            if lower >= 0 and not scene.fixed[lower] and not scene.held.contained[upper]:
                holds[scene.names[upper], False, int(lower)] += 1
            if (box := scene.held.inside[upper]) >= 0:
                holds[scene.names[upper], True, int(box)] += 1
        return holds

    @cached_property
    def _pairs(self) -> Counter[tuple[str, bool, str]]:
        """Number of pairs by (upper name, inside, lower name)."""
        pairs = Counter[tuple[str, bool, str]]()
        for (name, inside, lower), number in self._holds.items():
            pairs[name, inside, self.scene.names[lower]] += number
        return pairs

    def _pair(self) -> Claim | None:
        name, inside, under = self._pick(sorted(self._pairs))
        if self.scene.objects[under] == 1:
            return None  # "in the bowl" rather than "in a bowl"
        return PairCount(name, self._pairs[name, inside, under], inside, under)

    def _hold(self) -> Claim | None:
        name, inside, lower = self._pick(sorted(self._holds))
        landmark = self._refer(lower)
        return None if landmark is None else SupportCount(name, self._holds[name, inside, lower], inside, landmark)

    @cached_property
    def _stays(self) -> Counter[tuple[str, int, int]]:
        """Number of objects by (name, place, tier), for places with tiers or on another place; the floor is none."""
        held, scene = self.scene.held, self.scene
        named = (held.place[held.place] >= 0) | (scene.tiers[held.place] > 0)
        there = np.flatnonzero((held.place >= 0) & named & ~scene.fixed)
        return Counter((scene.names[i], int(held.place[i]), int(held.tier[i])) for i in there)

    def _stay(self) -> Claim | None:
        name, unit, tier = self._pick(sorted(self._stays))
        places = self._places(unit, tier)
        place = self._pick(places) if places else None
        return None if place is None else PlaceCount(name, self._stays[name, unit, tier], place)

    @cached_property
    def _neighbors(self) -> NDArray[np.int64]:
        """(P, 2) pairs of objects that share a place."""
        held = self.scene.held
        place, tier = held.place, held.tier
        same = (place[:, None] == place) & (tier[:, None] == tier) & (place >= 0)
        np.fill_diagonal(same, False)
        return np.argwhere(same)

    def _aside(self) -> Claim | None:
        first, second = self._neighbors[self.rng.integers(len(self._neighbors))].tolist()
        sides = [side for side in get_args(Side) if all(view.is_at(side, first, second) for view in self.views)]
        subject = self._refer(first) if sides else None
        landmark = self._refer(second) if subject is not None else None
        if subject is None or landmark is None:
            return None
        claim = SideClaim(subject, self._pick(sides), landmark)
        return None if _repeats_order(claim) else claim

    def _references(self, index: int) -> list[Reference]:
        """The simplest expressions for one object, which single it out in every view; empty when there are none. These
        are its name alone, or its name and place, or its rank counted from the sides where the rank is low.
        """
        if index not in self._known:
            self._known[index] = self._found_references(index)
        return self._known[index]

    def _found_references(self, index: int) -> list[Reference]:
        scene = self.views[0]
        name = scene.names[index]
        if scene.objects[name] == 1:
            return [Reference(name)]
        places: list[Place | None] = [None]
        members, held = scene.named(name), scene.held
        if not scene.fixed[index] and len({(held.place[i], held.tier[i]) for i in members}) > 1:
            unit, tier = int(held.place[index]), int(held.tier[index])
            places = [*self._places(unit, tier)] if unit >= 0 else []
        found = [Reference(name, place=place) for place in places if place is not None]
        if clear := [reference for reference in found if self._is_only(reference, index)]:
            return clear
        ranked = [reference for place in places for reference in self._ranked(index, name, place)]
        return [reference for reference in ranked if self._is_only(reference, index)]

    def _places(self, unit: int, tier: int) -> list[Place]:
        """Expressions for an object as a place, or for one of its tiers, counted from the nearer end."""
        tiers = int(self.scene.tiers[unit])
        if tiers and tier < 0:
            return []
        nearer = None if not tiers else tier if 2 * tier < tiers else tier - tiers
        return [Place(reference, nearer) for reference in self._references(unit) if reference.place is None]

    def _ranked(self, index: int, name: str, place: Place | None) -> list[Reference]:
        """References by rank, from the side where it is lowest, and from others where it is at most one higher."""
        scene = self.views[0]
        members = scene.named(name)
        if place is not None:
            members = members[place.holds(scene)[members]]
        edges = SIDES[:2] if scene.held.tier[index] >= 0 else SIDES
        along = {edge: scene.along(edge) for edge in edges}
        ranks = {edge: 1 + int((along[edge][members] > along[edge][index]).sum()) for edge in edges}
        highest = min(1 + min(ranks.values()), _LAST_ORDINAL)
        return [Reference(name, rank, edge, place) for edge, rank in ranks.items() if rank <= highest]

    def _is_only(self, reference: Reference, index: int) -> bool:
        return all(reference.resolve(view) == index for view in self.views)

    def _refer(self, index: int) -> Reference | None:
        references = self._references(index)
        return self._pick(references) if references else None

    def _pick(self, items: Sequence[_T]) -> _T:
        return items[int(self.rng.integers(len(items)))]


def _repeats_order(claim: SideClaim) -> bool:
    """Whether the claim repeats an order: "the first cup from the left is to the left of the second from the left"."""
    words = {claim.subject.edge, claim.side, claim.landmark.edge}
    return claim.subject.name == claim.landmark.name and (words <= {"left", "right"} or words <= {"front", "back"})
