"""Claim guidance: denoising whose poses are moved toward the claims of a prompt.

Claims become linear constraints on pairs of objects: what stands on, in, next to or at what.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import log_ndtr, ndtr
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.assets import AssetLibrary
from scene_envs.assets.support_shapes import library_shapes
from scene_envs.datasets.prompts import Tolerances, parse_prompt, scene_facts
from scene_envs.datasets.prompts.claims import Claim, PairCount, PlaceCount, Reference, SideClaim, SupportCount, holders
from scene_envs.datasets.prompts.facts import SceneFacts, viewer_axes
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType
from scene_envs.supports import CONTACT, LARGEST_CONTACT

logger = logging.getLogger(__name__)

_FINEST = 0.02
"""Error (m) of positions below which nothing is moved: the denoising that is left separates objects again."""
_SHALLOW = 0.02
"""Depth (m) of a plate, up to which objects stand on the middle of an object and not on its rim."""
_UPRIGHT = 0.85
"""Cosine of the tilt up to which an object carries others on its upper side."""


class ClaimGuidance:
    """Moves the objects of each scene toward the claims of its prompt, at every step of the denoising.

    At a step, the position of each object is approximately normal around the denoised scene, with the measured error
    of the prior as standard deviation. Each claim gives linear constraints on the difference of two positions, so the
    probability of each constraint has a closed form. Its gradient gives the mean of the positions under the condition
    that the constraint holds. The denoised positions move by ``strength`` times the difference to this mean. An object
    takes along what it carries. Guidance ends when the error is below 2 cm.

    Text that :func:`~scene_envs.datasets.parse_prompt` cannot read makes no claims.

    Args:
        prompts: B texts.
        scene_type: scene type of the scenes.
        strength: factor on the moves; 1 is the conditional mean of one constraint.
        movable: (B, N) bool, slots whose poses are denoised; None for all but the fixed ones.

    >>> guidance = ClaimGuidance(["A scene where the teapot is to the left of the cup."], "dimsum_table", 1.0)
    >>> guidance(0, 50, lambda: SceneBatch.empty("dimsum_table", 1), torch.full((3,), 0.1)).abs().max()
    tensor(0.)
    """

    def __init__(
        self, prompts: Sequence[str], scene_type: str | SceneType, strength: float, movable: Tensor | None = None
    ) -> None:
        self.strength = strength
        self._claims = [claims_of(prompt, scene_type) for prompt in prompts]
        self._axes = viewer_axes(scene_type)
        self._movable = None if movable is None else movable.cpu().numpy()

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor | None:
        """(B, N, 3) m, how far the denoised positions move; None when nothing moves any more.

        Args:
            step, steps: step and number of steps, which are not used.
            denoised: function that gives the B scenes that the network expects.
            std: (3,) standard deviation of their positions along the axes of the world, m.
        """
        error = np.sqrt(np.square(self._axes) @ np.square(std.cpu().double().numpy()))
        if error[:2].max() < _FINEST:
            return None
        batch = denoised().to("cpu")
        facts = scene_facts(batch, Tolerances(contact=float(np.clip(1.5 * error[2], CONTACT, LARGEST_CONTACT))))
        moves = np.zeros((*batch.tensor.shape[:2], 3))
        for row, (claims, scene) in enumerate(zip(self._claims, facts, strict=True)):
            if claims and scene.count:
                wanted = constraints(claims, scene, _surfaces(batch, row, scene), error)
                free = scene.slots >= len(batch.scene_type.fixed)
                free = free if self._movable is None else free & self._movable[row, scene.slots]
                moves[row, scene.slots] = self._moves(wanted, scene, error, free) @ self._axes
        return torch.as_tensor(moves, dtype=batch.tensor.dtype, device=std.device)

    def _moves(self, wanted: Sequence[Constraint], scene: SceneFacts, error: Array, free: Mask) -> Array:
        """(n, 3) m, in the frame of ``scene``: the sum of the moves for M constraints."""
        if not wanted:
            return np.zeros((scene.count, 3))
        first, second, axis, low, high, stays = map(np.array, zip(*wanted, strict=True))  # axis (M, 3), others (M,)
        carried = _carried(scene)
        movers = [_without(carried, first, second) & free, _without(carried, second, first) & free]  # (M, n) each
        moved = np.stack([who.any(axis=1) for who in movers])  # (2, M)
        uncertain = moved.sum(axis=0)
        moved[1] &= ~stays
        sides = moved.sum(axis=0)
        spread = np.sqrt(uncertain.clip(min=1)) * np.linalg.norm(axis * error, axis=1)
        offset = (axis * (scene.positions[first] - scene.positions[second])).sum(axis=1)
        size = self.strength * uncertain / sides.clip(min=1) * probability_slope(offset, low, high, spread)
        steps = size[:, None] * error**2 * axis
        moves = (movers[0] & moved[0][:, None]).T @ steps - (movers[1] & moved[1][:, None]).T @ steps
        return np.asarray(moves)


def probability_slope(value: Array, low: Array, high: Array, spread: Array) -> Array:
    """d ln P(low <= x <= high) / d value, 1/m, of normal x with means ``value`` and standard deviations ``spread``, m.

    The mean of x given that it lies in the interval is ``value + spread² * slope``. All arrays have one shape.

    >>> half_normal, far = probability_slope(np.array([0.0, -50.0]), np.zeros(2), np.array([np.inf, 0.5]), np.ones(2))
    >>> round(float(half_normal), 6)  # sqrt(2 / pi)
    0.797885
    >>> bool(far > 50.0)              # far outside: to the nearest bound and a little beyond
    True
    """
    below, above = (low - value) / spread, (high - value) / spread
    mirrored = below > 0  # by symmetry the same; keeps the digits of small probabilities
    below, above = np.where(mirrored, -above, below), np.where(mirrored, -below, above)
    with np.errstate(all="ignore"):  # both forms are computed everywhere, each is used where it is exact
        upper, lower = log_ndtr(above), log_ndtr(below)
        log_mass = np.where(above < 0, upper + np.log1p(-np.exp(lower - upper)), np.log(ndtr(above) - ndtr(below)))
    densities = [np.exp(-0.5 * z * z - 0.5 * np.log(2 * np.pi) - log_mass) for z in (below, above)]
    return np.asarray(np.where(mirrored, -1.0, 1.0) * (densities[0] - densities[1]) / spread)


def _carried(scene: SceneFacts) -> Mask:
    """(n, n) bool: [i, j] whether object j is i, or is held by i, directly or through others."""
    carried: Mask = np.eye(scene.count, dtype=bool)
    for upper in range(scene.count):
        lower = int(scene.held.support[upper])
        while lower >= 0 and not carried[lower, upper]:
            carried[lower, upper] = True
            lower = int(scene.held.support[lower])
    return carried


def _without(carried: Mask, who: Index, other: Index) -> Mask:
    """(M, n) bool: what moves with the objects ``who`` (M,), without ``other`` (M,) and what is on it."""
    moving: Mask = carried[who] & ~(carried[other] & carried[who, other][:, None])
    return moving


def _surfaces(batch: SceneBatch, row: int, scene: SceneFacts) -> Surfaces:
    """Surfaces of the objects of one scene that carry others."""
    shapes = library_shapes(batch.scene_type.library)
    categories = batch.categories[row].numpy()[scene.slots]
    origin = batch.translations[row, :, 2].double().numpy()[scene.slots] - scene.positions[:, 2]
    upright = batch.rotations[row, :, 2, 2].numpy()[scene.slots] > _UPRIGHT
    middle = _middles(batch.scene_type.library)[categories]
    highest = scene.boxes[:, 1, 2] - scene.positions[:, 2]
    flat = upright & (middle + origin > highest - _SHALLOW)  # false for a hollow object, whose rim carries others
    top = np.where(flat, middle + origin, highest)
    return Surfaces(top, shapes.tiers[categories] + origin[:, None])


@lru_cache(maxsize=32)
def _middles(library: AssetLibrary) -> Array:
    """(C,) height of the upper side of each asset at its middle, asset frame, m; -inf where nothing is."""
    shapes = library_shapes(library)
    every = np.arange(len(shapes.top))
    return np.asarray(shapes.top[shapes.cells(every, np.zeros((len(every), 3)))])


# -- constraints of claims ------------------------------------------------------------------------


_OFFSET, _CONE = 0.035, 1.3
"""Least offset (m) to a side, and its ratio to the offset across: the claim holds from 0.02 m and 1 on."""
_BESIDE = 0.02
"""Distance (m) of objects that are next to each other; the claim holds up to 0.05 m."""
_ORDER = 0.02
"""Least distance (m) between neighbours in an order."""
_NEAR = 0.35
"""Largest centre distance, as a share of the lower object's width, at which the upper may stand on it."""
_SHARP = 0.1
"""Error (m) of positions below which single supports are distinguished."""
_STOREY = 0.2
"""Largest difference of the heights (m) of two objects that may stand on each other."""


@lru_cache(maxsize=4096)
def claims_of(prompt: str, scene_type: str | SceneType) -> tuple[Claim, ...]:
    """The claims of a prompt; none, with one warning, where it cannot be read."""
    try:
        return parse_prompt(prompt, scene_type).claims if prompt.strip() else ()
    except InvalidInputError as error:
        logger.warning("%s. claim_guidance does nothing for this prompt.", error)
        return ()


def constraints(claims: Sequence[Claim], scene: SceneFacts, surfaces: Surfaces, error: Array) -> list[Constraint]:
    """Constraints under which ``claims`` hold, with as few changes of supports and orders as possible.

    Claims on numbers of objects have none (:mod:`agents.priors.guidance`). Nor do claims whose objects are not in the
    scene (yet).

    Args:
        claims: claims of one prompt.
        scene: n objects at their expected places.
        surfaces: surfaces of these objects.
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


def _refer(
    reference: Reference, scene: SceneFacts, surfaces: Surfaces, taken: int = -1
) -> tuple[int, list[Constraint]]:
    """Index of the referenced object (-1: none), and constraints that make the reference unambiguous.

    Objects that are counted at a place move there as far as the reference needs them. ``taken`` is the other object of
    the claim. Where both references mean the same object, its neighbour in the order is taken instead.
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
    """(3,) unit vector toward a side, in the axes right, front and up of positions."""
    axis, sign = {"left": (0, -1.0), "right": (0, 1.0), "front": (1, 1.0), "back": (1, -1.0)}[side]
    return sign * AXES[axis]


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
    """Constraints that move ``comes`` to the furniture and tier of ``stays``, or the reverse if ``stays`` has none."""
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
        supports = scene.named(claim.under)
    else:
        landmark, found = _refer(claim.landmark, scene, surfaces)
        supports = np.array([landmark] if landmark >= 0 else [], dtype=np.int64)
    members = scene.named(claim.name)
    if not len(supports) or not len(members):
        return found
    support_of = _likely_supports(claim, scene, members, supports, error)
    is_supported = np.isin(support_of[members], supports)
    missing = claim.number - int(is_supported.sum())
    kept, removed = list(members[is_supported]), []
    if missing > 0:
        for upper, lower in _closest_pairs(claim, scene, members[~is_supported], supports, support_of)[:missing]:
            found += stands_on(upper, lower, claim.inside, scene, surfaces)
    elif missing < 0 and error[:2].max() < _SHARP:
        bearing = set(support_of.tolist()) | set(scene.held.support.tolist())
        kept.sort(key=lambda index: (index in bearing, -distance_across(scene, index, support_of[index])))
        removed, kept = kept[:-missing], kept[-missing:]
    for index in kept if missing >= 0 or removed else []:
        found += stands_on(int(index), int(support_of[index]), claim.inside, scene, surfaces)
    for index in removed:
        found += stands_beside(int(index), int(support_of[index]), scene)
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
        across = distance_across(scene, np.arange(scene.count), unit)
        distance = across if tier is None else np.abs(height - levels[tier])
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


def _likely_supports(
    claim: PairCount | SupportCount, scene: SceneFacts, members: Index, supports: Index, error: Array
) -> Index:
    """(n,) support of each object; for ``members`` not on ``supports``, the likely one given the error.

    While heights are uncertain, an object is taken to stand on the highest of the objects below its middle.
    """
    support_of = holders(scene, claim.inside).copy()
    if claim.inside or error[:2].max() >= _SHARP:
        return support_of
    reach = _NEAR * sizes(scene)[:, :2].max(axis=1)
    height = scene.boxes[:, 0, 2]
    for index in members[~np.isin(support_of[members], supports)]:
        above = height[index] - height
        near = distance_across(scene, index, np.arange(scene.count)) < reach
        below: Mask = near & (above > 0.0) & (above < _STOREY)
        below[index] = False
        if below.any():
            nearest = int(np.where(below, above, np.inf).argmin())
            support_of[index] = nearest if nearest in supports else support_of[index]
    return support_of


def _closest_pairs(
    claim: PairCount | SupportCount, scene: SceneFacts, free: Index, supports: Index, support_of: Index
) -> list[tuple[int, int]]:
    """Pairs of an object of ``free`` and one of ``supports`` that may support it, the closest ones first.

    Every object is in one pair at most. Only containers, and the landmark of a claim, support several.
    """
    one_each = isinstance(claim, PairCount) and not claim.inside
    standing = scene.held.support[~scene.held.contained]
    occupied = {*support_of.tolist(), *standing.tolist()} if one_each else set()
    width = sizes(scene)[:, :2].max(axis=1)
    ranked = sorted(  # of two orders of a pair, the wider object below
        (float(distance_across(scene, upper, lower)), float(width[upper] - width[lower]), int(upper), int(lower))
        for upper in free
        for lower in supports
        if upper != lower and lower not in occupied and support_of[lower] != upper and not scene.carries(upper, lower)
    )
    under: dict[int, int] = {}
    for _, _, upper, lower in ranked:
        taken = upper in under or (one_each and lower in under.values())
        if not taken and not _stands_over(under, lower, upper):
            under[upper] = lower
    return list(under.items())


def _stands_over(under: Mapping[int, int], upper: int, lower: int) -> bool:
    """Whether the chain of objects under ``upper`` leads to ``lower``."""
    while (upper := under.get(upper, -1)) >= 0:
        if upper == lower:
            return True
    return False


# -- constraints on pairs -------------------------------------------------------------------------


AXES = np.eye(3)
"""Right, front and up, the axes of positions."""
_UPON = 0.15
"""Share of an object's width within which the centre of what stands on it lies, to each side of its own centre."""
_WITHIN = 0.25
"""The same share for objects in a container."""
_LEVEL = 0.004
"""Largest difference of the heights of two objects in contact (m)."""
_FLOOR, _FILL = 0.01, 0.03
"""Thickness (m) of the bottom of a container; height (m) above it within which the lowest objects lie."""
_REST = 0.01
"""Height (m) above a tier within which objects on it stand."""
_CLEAR = 1.1
"""Distance of objects that no longer stand on each other, over their mean width."""
_SPOT = 0.03
"""Distance (m) from the chosen place within which such an object comes."""
_OFF = 10.0
"""A place outside the furniture counts as less roomy by this factor times its distance."""


class Constraint(NamedTuple):
    """``low <= axis . (position of first - position of second) <= high``, in the frame of :class:`SceneFacts`.

    Attributes:
        first, second: indices of the two objects.
        axis: (3,) unit vector.
        low, high: bounds in m; infinite for none.
        second_stays: whether the first object alone may be moved.
    """

    first: int
    second: int
    axis: Array
    low: float
    high: float = np.inf
    second_stays: bool = False


class Surfaces(NamedTuple):
    """Heights of the surfaces of n objects that carry others, relative to the positions of :class:`SceneFacts`, m.

    Attributes:
        top: (n,) height of the upper side at the middle, or of the rim of a hollow object.
        tiers: (n, L) heights of the tiers, from the top; NaN for none.
    """

    top: Array
    tiers: Array


def sizes(scene: SceneFacts) -> Array:
    """(n, 3) extent of each object, m."""
    return np.asarray(scene.boxes[:, 1] - scene.boxes[:, 0])


def distance_across(scene: SceneFacts, first: int | Index, second: int | Index) -> Array:
    """Horizontal distances of two sets of objects, m."""
    offset = scene.positions[first] - scene.positions[second]
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def height_above_foot(scene: SceneFacts, index: int) -> float:
    """Height of an object's position above its lowest point, m."""
    return float(scene.positions[index, 2] - scene.boxes[index, 0, 2])


def stands_on(upper: int, lower: int, inside: bool, scene: SceneFacts, surfaces: Surfaces) -> Iterator[Constraint]:
    """Constraints under which ``upper`` stands on ``lower``, or lies in it."""
    share = _WITHIN if inside else _UPON
    for axis in (0, 1):
        reach = share * sizes(scene)[lower, axis]
        yield Constraint(upper, lower, AXES[axis], -reach, reach)
    surface = _FLOOR - height_above_foot(scene, lower) if inside else surfaces.top[lower]
    height = surface + height_above_foot(scene, upper)
    yield Constraint(upper, lower, AXES[2], height - _LEVEL, height + _LEVEL + (_FILL if inside else 0.0))


def stands_beside(upper: int, lower: int, scene: SceneFacts) -> Iterator[Constraint]:
    """Constraints that move ``upper`` from ``lower`` to the place next to it that has most room."""
    base = lower
    while (below := int(scene.held.support[base])) >= 0 and not scene.fixed[below]:
        base = below
    target = _roomiest(upper, lower, scene) - scene.positions[lower, :2]
    for axis in (0, 1):
        yield Constraint(upper, lower, AXES[axis], target[axis] - _SPOT, target[axis] + _SPOT, second_stays=True)
    height = scene.boxes[base, 0, 2] + height_above_foot(scene, upper) - scene.positions[lower, 2]
    yield Constraint(upper, lower, AXES[2], height - _LEVEL, height + _LEVEL, second_stays=True)


def _roomiest(upper: int, lower: int, scene: SceneFacts) -> Array:
    """(2,) place around ``lower``, on the same furniture, that is farthest from all other objects."""
    clear = _CLEAR * float(sizes(scene)[[upper, lower], :2].mean())
    angles = np.arange(16) * np.pi / 8
    places = scene.positions[lower, :2] + clear * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (16, 2)
    others = ~scene.fixed & (np.arange(scene.count) != upper) & (np.arange(scene.count) != lower)
    offsets = places[:, None] - scene.positions[None, others, :2]
    room = np.hypot(offsets[..., 0], offsets[..., 1]).min(axis=1, initial=clear)
    unit = int(scene.held.place[lower])
    if unit >= 0:
        low, high = scene.boxes[unit, 0, :2], scene.boxes[unit, 1, :2]
        room -= np.maximum(low - places, places - high).max(axis=1).clip(min=0.0) * _OFF
    return np.asarray(places[room.argmax()])


def stands_at(index: int, unit: int, scene: SceneFacts, level: float | None) -> Iterator[Constraint]:
    """Constraints that put an object in the outline of furniture ``unit``, ``level`` above its position."""
    low, high = scene.boxes[unit] - scene.positions[unit]
    margin = sizes(scene)[index] / 2
    for axis in (0, 1):
        least, most = low[axis] + margin[axis], high[axis] - margin[axis]
        if least < most:
            yield Constraint(index, unit, AXES[axis], least, most, second_stays=True)
    if level is not None:
        height = level + height_above_foot(scene, index)
        yield Constraint(index, unit, AXES[2], height - _LEVEL, height + _REST, second_stays=True)
