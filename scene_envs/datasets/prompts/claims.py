"""Claims of a prompt, and their check against a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scene_envs.datasets.prompts.facts import SceneFacts

Side = Literal["left", "right", "front", "back", "next"]
"""Relations between two objects that share a table, a tier or the floor."""


@dataclass(frozen=True)
class Reference:
    """One object: "the teapot", "the second cup from the left", "the lamp on the top shelf".

    Attributes:
        name: Display name.
        ordinal: Rank counted from ``edge``; 0 when there is only one such object.
        edge: Side from which objects are counted: left, right, front or back; empty without an ordinal.
        place: Place in which objects are counted; None for the whole scene.
    """

    name: str
    ordinal: int = 0
    edge: str = ""
    place: Place | None = None

    def resolve(self, scene: SceneFacts) -> int:
        """Index of the object; -1 when there is none, or when there are several and the reference has no ordinal."""
        members = scene.named(self.name)
        if self.place is not None:
            members = members[self.place.holds(scene)[members]]
        if not self.ordinal:
            return int(members[0]) if len(members) == 1 else -1
        if not 2 <= len(members) >= self.ordinal:
            return -1
        order = scene.along(self.edge)[members]
        ranks = np.argsort(-order, kind="stable")
        near = np.sort(np.abs(order - order[ranks[self.ordinal - 1]]))[1]
        return int(members[ranks[self.ordinal - 1]]) if near >= scene.tolerances.order else -1


@dataclass(frozen=True)
class Place:
    """A table, a shelf, or one tier of it: "the second table from the left", "the top shelf".

    Attributes:
        unit: Piece of furniture.
        tier: Tier 0, 1, … counted from the top, or -1, -2, … counted from the bottom; None for the whole piece.
    """

    unit: Reference
    tier: int | None = None

    def holds(self, scene: SceneFacts) -> NDArray[np.bool_]:
        """(n,) bool: objects that are at this place, directly or on top of or in others."""
        unit = self.unit.resolve(scene)
        here = (scene.held.place == unit) & (unit >= 0)
        if self.tier is None or unit < 0:
            return here
        tier = self.tier if self.tier >= 0 else self.tier + int(scene.tiers[unit])
        return here & (scene.held.tier == tier) & (0 <= tier < scene.tiers[unit])


@dataclass(frozen=True)
class ClaimCheck:
    """Check of one claim in one scene.

    Attributes:
        claim: Claim that was checked.
        expected: Number that the claim gives; 1 for a relation between two objects.
        found: Number in the scene; for a relation 1 when it holds, else 0.
        score: 1 when the claim holds. A number that does not hold scores the smaller number over the larger. A relation
            that does not hold scores a quarter for each of its two objects that is in the scene.
        slots: Slots of the objects of the claim that are in the scene.
    """

    claim: Claim
    expected: int
    found: int
    score: float
    slots: tuple[int, ...]

    @property
    def holds(self) -> bool:
        """Whether the claim is true."""
        return self.expected == self.found


@dataclass(frozen=True)
class ObjectCount:
    """ "12 objects": objects in the scene, welded ones included."""

    number: int

    def check(self, scene: SceneFacts) -> ClaimCheck:
        return _count(self, self.number, scene, np.arange(scene.count))


@dataclass(frozen=True)
class NameCount:
    """ "three cups": objects of that display name."""

    name: str
    number: int

    def check(self, scene: SceneFacts) -> ClaimCheck:
        return _count(self, self.number, scene, scene.named(self.name))


@dataclass(frozen=True)
class PlaceCount:
    """ "three cups are on the second table from the left": objects on or in other objects there are included."""

    name: str
    number: int
    place: Place

    def check(self, scene: SceneFacts) -> ClaimCheck:
        members = scene.named(self.name)
        return _count(self, self.number, scene, members[self.place.holds(scene)[members]])


@dataclass(frozen=True)
class SupportCount:
    """ "two apples are in the bowl", "a mug is on top of the second plate from the left": held by one object.

    "On top of" means directly on the object. "In" means in the object, directly or on top of another object in it.
    """

    name: str
    number: int
    inside: bool
    landmark: Reference

    def check(self, scene: SceneFacts) -> ClaimCheck:
        holder = self.landmark.resolve(scene)
        members = scene.named(self.name) if holder >= 0 else np.empty(0, dtype=np.int64)
        return _count(self, self.number, scene, members[holders(scene, self.inside)[members] == holder])


@dataclass(frozen=True)
class PairCount:
    """ "two steamer lids are each on top of a steamer bottom": objects of one name held by objects of another."""

    name: str
    number: int
    inside: bool
    under: str

    def check(self, scene: SceneFacts) -> ClaimCheck:
        members = scene.named(self.name)
        held = np.isin(holders(scene, self.inside)[members], scene.named(self.under))
        return _count(self, self.number, scene, members[held])


@dataclass(frozen=True)
class SideClaim:
    """ "the lamp is to the left of the bowl": both objects share a table, a tier or the floor."""

    subject: Reference
    side: Side
    landmark: Reference

    def check(self, scene: SceneFacts) -> ClaimCheck:
        first, second = self.subject.resolve(scene), self.landmark.resolve(scene)
        there = [index for index in (first, second) if index >= 0]
        holds = len(there) == 2 and scene.is_at(self.side, first, second)
        score = 1.0 if holds else 0.25 * len(there)
        return ClaimCheck(self, 1, int(holds), score, tuple(int(slot) for slot in scene.slots[there]))


Claim = ObjectCount | NameCount | PlaceCount | SupportCount | PairCount | SideClaim


@dataclass(frozen=True)
class PromptFacts:
    """Claims of one prompt, in the order of the text.

    >>> from scene_envs.datasets import parse_prompt, scene_facts
    >>> from scene_envs.scene import SceneBatch
    >>> (scene,) = scene_facts(SceneBatch.empty("dimsum_table", 1))
    >>> prompt = parse_prompt("A scene with a table and two cups.", "dimsum_table")
    >>> prompt.holds(scene), prompt.score(scene), [check.found for check in prompt.check(scene)]
    (False, 0.5, [1, 0])
    """

    claims: tuple[Claim, ...]

    @property
    def count(self) -> int | None:
        """The number of objects claimed; None when the prompt claims no such number."""
        return next((claim.number for claim in self.claims if isinstance(claim, ObjectCount)), None)

    @property
    def objects(self) -> Counter[str] | None:
        """Display name to number as claimed; None when the prompt is no list of names."""
        named = Counter({claim.name: claim.number for claim in self.claims if isinstance(claim, NameCount)})
        return named or None

    def check(self, scene: SceneFacts) -> tuple[ClaimCheck, ...]:
        """The check of each claim: its truth, the numbers claimed and found, and the slots it is about."""
        return tuple(claim.check(scene) for claim in self.claims)

    def holds(self, scene: SceneFacts) -> bool:
        """Whether every claim is true of ``scene``; the numbers of named objects must match exactly."""
        return all(check.holds for check in self.check(scene))

    def score(self, scene: SceneFacts) -> float:
        """Mean of the claims' scores, in [0, 1]; 1 exactly when every claim holds."""
        return float(np.mean([check.score for check in self.check(scene)]))


def _count(claim: Claim, number: int, scene: SceneFacts, members: NDArray[np.int64] | Sequence[int]) -> ClaimCheck:
    found = len(members)
    score = min(number, found) / max(number, found, 1) if number != found else 1.0
    return ClaimCheck(claim, number, found, score, tuple(int(slot) for slot in scene.slots[members]))


def holders(scene: SceneFacts, inside: bool) -> NDArray[np.int64]:
    """(n,) index of the container that each object lies in if ``inside``, else of its support; -1 for none. An object
    in a container stands on nothing.
    """
    return scene.held.inside if inside else np.where(scene.held.contained, -1, scene.held.support)
