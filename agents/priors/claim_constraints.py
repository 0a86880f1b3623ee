"""Constraints that the claims of a prompt put on the positions of a scene."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache

import numpy as np

from agents.priors.pair_constraints import (
    AXES,
    Constraint,
    Surfaces,
    distance_across,
    sizes,
    stands_at,
    stands_beside,
    stands_on,
)
from scene_envs.arrays import Array, Index, Mask
from scene_envs.datasets.prompts import parse_prompt
from scene_envs.datasets.prompts.claims import (
    Claim,
    PairCount,
    PlaceCount,
    Reference,
    SideClaim,
    SupportCount,
    holders,
)
from scene_envs.datasets.prompts.facts import SceneFacts
from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import SceneType

_OFFSET, _CONE = 0.035, 1.3
"""Least offset (m) to a side, and its ratio to the offset across: the claim holds from 0.02 m and 1 on."""
_BESIDE = 0.02
"""Distance (m) of things that are next to each other; the claim holds up to 0.05 m."""
_ORDER = 0.02
"""Least distance (m) between neighbours in an order."""
_NEAR = 0.35
"""A thing whose centre is within this share of the width of another may stand on it, given the error of positions."""
_SHARP = 0.1
"""Error (m) of positions below which single supports can be told apart."""
_STOREY = 0.2
"""Difference of the heights (m) of two things that may stand on each other."""


@lru_cache(maxsize=4096)
def claims_of(prompt: str, scene_type: str | SceneType) -> tuple[Claim, ...]:
    """The claims of a prompt; none where it cannot be read."""
    try:
        return parse_prompt(prompt, scene_type).claims if prompt.strip() else ()
    except InvalidInputError:
        return ()


def constraints(claims: Sequence[Claim], scene: SceneFacts, surfaces: Surfaces, error: Array) -> list[Constraint]:
    """Constraints under which ``claims`` hold, with as few changes of supports and orders as possible.

    Claims on numbers of objects have none (:mod:`agents.priors.number_guidance`). Nor do claims whose things are not in
    the scene (yet).

    Args:
        claims: of one prompt.
        scene: n objects, expected at their places.
        surfaces: of these objects.
        error: (3,) standard deviation of the positions, m.
    """
    found: list[Constraint] = []
    placed = {claim.name for claim in claims if isinstance(claim, PlaceCount)}
    for claim in claims:
        if isinstance(claim, SideClaim):
            found += _side(claim, scene, surfaces, placed)
        elif isinstance(claim, PairCount | SupportCount):
            found += _support(claim, scene, surfaces, error)
        elif isinstance(claim, PlaceCount):
            found += _place(claim, scene, surfaces)
    return found


# -- references -------------------------------------------------------------------------------------


def _refer(
    reference: Reference, scene: SceneFacts, surfaces: Surfaces, taken: int = -1
) -> tuple[int, list[Constraint]]:
    """The object that a reference means, -1 for none, and the constraints under which it means this one.

    Things that are counted at a place come there as far as the reference needs them. ``taken`` is the other thing of
    the claim. Where both references mean the same object, its neighbour in the order takes its place.
    """
    members, found = scene.named(reference.name), []
    if reference.place is not None:
        here = members[reference.place.holds(scene)[members]]
        needed = max(2, reference.ordinal) if reference.ordinal else 1
        if len(here) < needed or (len(here) > 1 and not reference.ordinal):
            found = _place(PlaceCount(reference.name, needed, reference.place), scene, surfaces)
        members = here
    if not reference.ordinal:
        return (int(members[0]) if len(members) == 1 else -1), found
    if not 2 <= len(members) >= reference.ordinal:
        return -1, found
    along = scene.along(reference.edge)
    ranked = [int(index) for index in members[np.argsort(-along[members], kind="stable")]]
    rank = reference.ordinal - 1
    chosen = ranked[rank]
    if chosen == taken:
        neighbours = [ranked[other] for other in (rank - 1, rank + 1) if 0 <= other < len(ranked)]
        chosen = min(neighbours, key=lambda other: abs(along[other] - along[taken]))
    rest = [index for index in ranked if index != chosen]
    axis = _direction(reference.edge)
    if rank:
        found.append(Constraint(rest[rank - 1], chosen, axis, _ORDER))
    if rank < len(rest):
        found.append(Constraint(chosen, rest[rank], axis, _ORDER))
    return chosen, found


def _direction(side: str) -> Array:
    """(3,) unit vector of a side: of right, front and up, as positions."""
    axis, sign = {"left": (0, -1.0), "right": (0, 1.0), "front": (1, 1.0), "back": (1, -1.0)}[side]
    return sign * AXES[axis]


# -- claims -----------------------------------------------------------------------------------------


def _side(claim: SideClaim, scene: SceneFacts, surfaces: Surfaces, placed: Collection[str]) -> list[Constraint]:
    first, found = _refer(claim.subject, scene, surfaces)
    second, more = _refer(claim.landmark, scene, surfaces, first)
    found += more
    if first < 0 or second < 0 or first == second:
        return found
    stays_first, stays_second = (ref.place is not None or ref.name in placed for ref in (claim.subject, claim.landmark))
    pair = (second, first) if stays_first and not stays_second else (first, second)
    found += _come_together(*pair, scene, surfaces)
    if claim.side == "next":
        reach = (sizes(scene)[first] + sizes(scene)[second]) / 2 + _BESIDE
        return found + [Constraint(first, second, AXES[axis], -reach[axis], reach[axis]) for axis in (0, 1)]
    ahead = _direction(claim.side)
    across = np.cross(AXES[2], ahead)
    cone = [(ahead + sign * _CONE * across) / np.hypot(1.0, _CONE) for sign in (-1.0, 1.0)]
    return [*found, Constraint(first, second, ahead, _OFFSET), *(Constraint(first, second, a, 0.0) for a in cone)]


def _come_together(comes: int, stays: int, scene: SceneFacts, surfaces: Surfaces) -> list[Constraint]:
    """One thing comes to the furniture and the tier of another; the other way where the other is on no furniture."""
    place, tier = scene.held.place, scene.held.tier
    if place[comes] == place[stays] and tier[comes] == tier[stays]:
        return []
    comes, stays = (comes, stays) if place[stays] >= 0 else (stays, comes)
    unit, levels = int(place[stays]), surfaces.tiers[place[stays]]
    if comes == unit or scene.fixed[comes]:
        return []
    return list(stands_at(comes, unit, scene, float(levels[tier[stays]]) if scene.tiers[unit] > 1 else None))


def _support(claim: PairCount | SupportCount, scene: SceneFacts, surfaces: Surfaces, error: Array) -> list[Constraint]:
    if isinstance(claim, PairCount):
        found: list[Constraint] = []
        holding = scene.named(claim.under)
    else:
        landmark, found = _refer(claim.landmark, scene, surfaces)
        holding = np.array([landmark] if landmark >= 0 else [], dtype=np.int64)
    members = scene.named(claim.name)
    if not len(holding) or not len(members):
        return found
    holder = _likely_holders(claim, scene, members, holding, error)
    held = np.isin(holder[members], holding)
    missing = claim.number - int(held.sum())
    stays, leaves = list(members[held]), []
    if missing > 0:
        for upper, lower in _closest_pairs(claim, scene, members[~held], holding, holder)[:missing]:
            found += stands_on(upper, lower, claim.inside, scene, surfaces)
    elif missing < 0 and error[:2].max() < _SHARP:
        bears = set(holder.tolist()) | set(scene.held.support.tolist())
        stays.sort(key=lambda index: (index in bears, -distance_across(scene, index, holder[index])))
        leaves, stays = stays[:-missing], stays[-missing:]
    for index in stays if missing >= 0 or leaves else []:
        found += stands_on(int(index), int(holder[index]), claim.inside, scene, surfaces)
    for index in leaves:
        found += stands_beside(int(index), int(holder[index]), scene)
    return found


def _place(claim: PlaceCount, scene: SceneFacts, surfaces: Surfaces) -> list[Constraint]:
    unit, found = _refer(claim.place.unit, scene, surfaces)
    members = scene.named(claim.name)
    if unit < 0 or not len(members):
        return []
    levels = surfaces.tiers[unit][np.isfinite(surfaces.tiers[unit])]
    tier = None if claim.place.tier is None else claim.place.tier % max(len(levels), 1)
    if claim.place.tier is not None and not len(levels):
        return []
    here = claim.place.holds(scene)[members]
    missing = claim.number - int(here.sum())
    height = scene.boxes[:, 0, 2] - scene.positions[unit, 2]
    if missing > 0:
        distance = (
            np.abs(height - levels[tier]) if tier is not None else distance_across(scene, np.arange(scene.count), unit)
        )
        for index in sorted(members[~here], key=lambda index: distance[index])[:missing]:
            found += stands_at(int(index), unit, scene, None if tier is None else levels[tier])
    elif missing < 0 and tier is not None and len(levels) > 1:
        others = np.delete(levels, tier)
        for index in sorted(members[here], key=lambda index: np.abs(height[index] - others).min())[:-missing]:
            found += stands_at(int(index), unit, scene, others[np.abs(height[index] - others).argmin()])
    elif missing < 0 and tier is None and len(units := np.setdiff1d(scene.named(claim.place.unit.name), [unit])):
        away = np.stack([distance_across(scene, np.arange(scene.count), other) for other in units])  # (U, n)
        bears = set(scene.held.support.tolist())
        for index in sorted(members[here], key=lambda index: (index in bears, away[:, index].min()))[:-missing]:
            found += stands_at(int(index), int(units[away[:, index].argmin()]), scene, None)
    return found


# -- supports ---------------------------------------------------------------------------------------


def _likely_holders(
    claim: PairCount | SupportCount, scene: SceneFacts, members: Index, holding: Index, error: Array
) -> Index:
    """(n,) what holds each object; for ``members`` not held by ``holding``, what may do so given the error.

    While heights are uncertain, a thing is taken to stand on the highest of the things below its middle.
    """
    holder = holders(scene, claim.inside).copy()
    if claim.inside or error[:2].max() >= _SHARP:
        return holder
    reach = _NEAR * sizes(scene)[:, :2].max(axis=1)
    height = scene.boxes[:, 0, 2]
    for index in members[~np.isin(holder[members], holding)]:
        above = height[index] - height
        below: Mask = (
            (distance_across(scene, index, np.arange(scene.count)) < reach) & (above > 0.0) & (above < _STOREY)
        )
        below[index] = False
        if below.any():
            nearest = int(np.where(below, above, np.inf).argmin())
            holder[index] = nearest if nearest in holding else holder[index]
    return holder


def _closest_pairs(
    claim: PairCount | SupportCount, scene: SceneFacts, free: Index, holding: Index, holder: Index
) -> list[tuple[int, int]]:
    """Pairs of a thing that nothing of ``holding`` holds and one that may hold it, the closest ones first.

    Every thing is in one pair at most. Only containers, and the landmark of a claim, hold several.
    """
    one_each = isinstance(claim, PairCount) and not claim.inside
    occupied = set(holder.tolist()) | set(scene.held.support[~scene.held.contained].tolist()) if one_each else set()
    width = sizes(scene)[:, :2].max(axis=1)
    ranked = sorted(  # of two orders of a pair, the wider thing below
        (float(distance_across(scene, upper, lower)), float(width[upper] - width[lower]), int(upper), int(lower))
        for upper in free
        for lower in holding
        if upper != lower and lower not in occupied and holder[lower] != upper and not scene.carries(upper, lower)
    )
    under: dict[int, int] = {}
    for _, _, upper, lower in ranked:
        taken = upper in under or (one_each and lower in under.values())
        if not taken and not _stands_over(under, lower, upper):
            under[upper] = lower
    return list(under.items())


def _stands_over(under: Mapping[int, int], upper: int, lower: int) -> bool:
    """Whether the chain of things under ``upper`` leads to ``lower``."""
    while (upper := under.get(upper, -1)) >= 0:
        if upper == lower:
            return True
    return False
