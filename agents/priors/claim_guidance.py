"""Claim guidance: denoising whose poses are moved toward the claims of a prompt.

Claims become linear constraints on pairs of objects: what stands on, in, next to or at what. The claims of a batch are
tables of numbers, and every operation runs over all scenes, on their device; only lengths of lists are read back.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor
from torch.special import log_ndtr, ndtr

from scene_envs.arrays import constant_on
from scene_envs.assets import AssetLibrary
from scene_envs.datasets.prompts import parse_prompt
from scene_envs.datasets.prompts.claims import Claim, PairCount, Place, PlaceCount, Reference, SideClaim, SupportCount
from scene_envs.datasets.prompts.facts import SIDES, viewer_axes
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type
from scene_envs.supports import CONTACT, LARGEST_CONTACT, Contacts, Holding, Placed

logger = logging.getLogger(__name__)

_FINEST = 0.02
"""Error (m) of positions below which nothing is moved: the denoising that is left separates objects again."""
_SHALLOW, _UPRIGHT = 0.02, 0.85
"""Depth (m) of a plate up to which objects stand on its middle, not on its rim; least cosine of its tilt."""


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
        self._claims = claim_tables([claims_of(prompt, scene_type) for prompt in prompts], get_scene_type(scene_type))
        self._axes = torch.from_numpy(viewer_axes(scene_type))
        self._movable = movable

    def acts(self, std: Tensor) -> bool:
        """Whether anything moves at steps whose denoised positions have the standard deviation ``std`` (3,), m."""
        return bool(self._error(std)[:2].max() >= _FINEST)

    def _error(self, std: Tensor) -> Tensor:
        return (constant_on(self._axes, std.device).square() @ std.double().square()).sqrt()

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor:
        """(B, N, 3) m, how far the positions of the scenes ``denoised()`` move; their standard deviation along the axes
        of the world is ``std`` (3,), m. ``step`` and ``steps`` are not used.
        """
        batch, error, axes = denoised(), self._error(std), constant_on(self._axes, std.device)
        claims = [constant_on(table, std.device) for table in self._claims]
        scenes = Scenes.of(batch, axes, (1.5 * error[2]).clamp(CONTACT, LARGEST_CONTACT))
        free = torch.arange(batch.tensor.shape[1], device=std.device) >= len(batch.scene_type.fixed)
        free = (free if self._movable is None else free & constant_on(self._movable, std.device)).expand_as(
            scenes.names
        )
        return (self._moves(constraints(claims, scenes, error), scenes, error, free) @ axes).to(batch.tensor)

    def _moves(self, wanted: Tensor, scenes: Scenes, error: Tensor, free: Tensor) -> Tensor:
        """(B, N, 3) m, in the frame of ``scenes``: the sum of the moves for K constraints on objects that are free."""
        slots, axis, (low, high, stays) = scenes.names.shape[1], wanted[:, 2:5], wanted[:, 5:].unbind(1)
        pair = wanted[:, :2].long()
        scene, (first, second) = pair[:, 0] // slots, (pair % slots).unbind(1)
        movers = []  # (K, N) each: what moves with an object, without the other one and what is on it
        for who, other in ((first, second), (second, first)):
            without = scenes.carried[scene, other] & scenes.carried[scene, who, other][:, None]
            movers.append(scenes.carried[scene, who] & ~without & free[scene])
        moved = torch.stack([who.any(dim=1) for who in movers])  # (2, K)
        uncertain = moved.sum(dim=0)
        moved[1] &= stays == 0
        spread = uncertain.clamp(min=1).sqrt() * (axis * error).norm(dim=1)
        offset = (axis * (scenes.positions[scene, first] - scenes.positions[scene, second])).sum(dim=1)
        slope = probability_slope(offset, low, high, spread)
        steps = (self.strength * uncertain / moved.sum(dim=0).clamp(min=1) * slope)[:, None] * error.square() * axis
        signs = (movers[0] & moved[0][:, None]).double() - (movers[1] & moved[1][:, None]).double()
        return torch.zeros_like(scenes.positions).index_add(0, scene, signs[..., None] * steps[:, None])


def probability_slope(value: Tensor, low: Tensor, high: Tensor, spread: Tensor) -> Tensor:
    """d ln P(low <= x <= high) / d value, 1/m, of normal x with means ``value`` and standard deviations ``spread``, m.

    The mean of x given that it lies in the interval is ``value + spread² * slope``. All have one shape, in float64.

    >>> one = torch.ones(2, dtype=torch.float64)
    >>> half_normal, far = probability_slope(one * 0, one * 0, one * torch.inf, one)[0], probability_slope(
    ...     one * -50, one * 0, one * 0.5, one)[0]
    >>> round(float(half_normal), 6)  # sqrt(2 / pi)
    0.797885
    >>> bool(far > 50.0)              # far outside: to the nearest bound and a little beyond
    True
    """
    below, above = (low - value) / spread, (high - value) / spread
    mirrored = below > 0  # by symmetry the same; keeps the digits of small probabilities
    below, above = torch.where(mirrored, -above, below), torch.where(mirrored, -below, above)
    upper, lower = log_ndtr(above), log_ndtr(below)  # both forms are computed, each is used where it is exact
    log_mass = torch.where(above < 0, upper + torch.log1p(-(lower - upper).exp()), (ndtr(above) - ndtr(below)).log())
    densities = [(-0.5 * z * z - 0.5 * math.log(2 * math.pi) - log_mass).exp() for z in (below, above)]
    return torch.where(mirrored, -1.0, 1.0) * (densities[0] - densities[1]) / spread


# -- scenes and claims as tables ------------------------------------------------------------------


class Scenes(NamedTuple):
    """Objects of B scenes in N slots, at their expected places; m, along the axes right, front and up."""

    names: Tensor  # (B, N) number of the display name; -1 for an empty slot
    positions: Tensor  # (B, N, 3) centres of mass
    low: Tensor  # (B, N, 3) lowest corners of bounding boxes
    high: Tensor  # (B, N, 3) highest corners
    sizes: Tensor  # (B, N, 3) extents
    foot: Tensor  # (B, N) height of each position above the object's lowest point
    fixed: Tensor  # (B, N) bool, welded objects
    levels: Tensor  # (B, N, L) heights of the tiers above the position, from the top; NaN for none
    top: Tensor  # (B, N) height above the position of the upper side at the middle, or of the rim of a hollow object
    held: Holding[Tensor]  # (B, N) each, supports by slots
    carried: Tensor  # (B, N, N) bool: [i, j] whether object j is i, or is held by i, directly or through others

    @classmethod
    def of(cls, batch: SceneBatch, axes: Tensor, contact: Tensor) -> Scenes:
        """The scenes of ``batch`` along ``axes`` (3, 3), whose surfaces touch within ``contact`` (), m."""
        shapes, placed = Placed.of_scenes(batch.scene_type, batch.categories, batch.translations, batch.rotations)
        loose = Contacts.of(shapes, placed).holding(contact).counted(placed.slot)
        points, center = axes @ placed.points, placed.center @ axes.T
        low, high = points.amin(dim=-1), points.amax(dim=-1)
        origin, highest = placed.translation[:, 2] - center[:, 2], high[:, 2] - center[:, 2]
        middle = origin + shapes.top[shapes.cells(placed.category, torch.zeros_like(center))]
        flat = (placed.rotation[:, 2, 2] > _UPRIGHT) & (middle > highest - _SHALLOW)  # not hollow: no rim carries
        top, levels = torch.where(flat, middle, highest), shapes.tiers[placed.category] + origin[:, None]
        corners = low, high, high - low, center[:, 2] - low[:, 2]
        names = constant_on(names_of(batch.scene_type.library)[1], center.device)[placed.category]
        columns = [placed.padded(column) for column in (names, center, *corners, placed.fixed, levels, top)]
        held = Holding(**{name: placed.padded(column) for name, column in vars(loose).items()})
        return cls._make([*columns, held, placed.carried(loose.support)])

    def distances(self, rows: Tensor) -> Tensor:
        """(M, N, N) horizontal distances in the scenes ``rows`` (M,)."""
        x, y = (side[:, :, None] - side[:, None] for side in self.positions[rows].unbind(-1)[:2])
        return torch.hypot(x, y)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """Rows of (B, N, ...) by numbers scene * N + slot."""
    return values.flatten(0, 1)[index]


@lru_cache(maxsize=32)
def names_of(library: AssetLibrary) -> tuple[dict[str, int], Tensor]:
    """Numbers of display names, and the number of each asset (C,)."""
    numbers: dict[str, int] = {}
    of_asset = [numbers.setdefault(asset.display_name, len(numbers)) for asset in library]
    return numbers, torch.tensor(of_asset)


_EDGES = ("", *SIDES, "next")
_DIRECTIONS = torch.tensor([[0, 0, 0], [-1, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0]], dtype=torch.float64)
"""Unit vectors toward the sides, in the axes right, front and up of positions."""
_NOWHERE, _UNKNOWN, _WHOLE = -9, -2, 99
"""Numbers of a unit where there is no place, of a name that the library lacks, and of the tier of a whole unit."""


@lru_cache(maxsize=4096)
def claims_of(prompt: str, scene_type: str | SceneType) -> tuple[Claim, ...]:
    """The claims of a prompt; none, with one warning, where it cannot be read."""
    try:
        return parse_prompt(prompt, scene_type).claims if prompt.strip() else ()
    except InvalidInputError as error:
        logger.warning("%s. claim_guidance does nothing for this prompt.", error)
        return ()


def claim_tables(claims: Sequence[Sequence[Claim]], scene_type: SceneType) -> list[Tensor]:
    """Three tables of the claims of each scene on sides, supports and places, in numbers; a row is a claim.

    A place is the name, ordinal and edge of its unit, and a tier. A reference is a name, ordinal, edge and place.
    Sides: scene, side, whether the landmark comes to the subject, two references. Supports: scene, name, number,
    whether in it, whether any object of the name below, reference. Places: scene, name, number, place. Claims on
    numbers of objects have no rows (:mod:`agents.priors.guidance`).
    """
    numbers, _ = names_of(scene_type.library)

    def at(place: Place | None) -> list[int]:
        if place is None:
            return [_NOWHERE, 0, 0, _WHOLE]
        return [*refer(place.unit)[:3], _WHOLE if place.tier is None else place.tier]

    def refer(to: Reference) -> list[int]:
        return [numbers.get(to.name, _UNKNOWN), to.ordinal, _EDGES.index(to.edge), *at(to.place)]

    tables: list[list[list[int]]] = [[], [], []]
    for scene, of_scene in enumerate(claims):
        placed = {claim.name for claim in of_scene if isinstance(claim, PlaceCount)}
        for claim in of_scene:
            if isinstance(claim, SideClaim):
                stays = [ref.place is not None or ref.name in placed for ref in (claim.subject, claim.landmark)]
                both = *refer(claim.subject), *refer(claim.landmark)
                tables[0].append([scene, _EDGES.index(claim.side), stays[0] and not stays[1], *both])
            elif isinstance(claim, PairCount | SupportCount):
                below = Reference(claim.under) if isinstance(claim, PairCount) else claim.landmark
                told = claim.number, claim.inside, isinstance(claim, PairCount), *refer(below)
                tables[1].append([scene, *refer(Reference(claim.name))[:1], *told])
            elif isinstance(claim, PlaceCount):
                tables[2].append([scene, *refer(Reference(claim.name))[:1], claim.number, *at(claim.place)])
    return [torch.tensor(table, dtype=torch.int64) for table in tables]


# -- constraints of claims ------------------------------------------------------------------------


_OFFSET, _CONE = 0.035, 1.3
"""Least offset (m) to a side, and its ratio to the offset across: the claim holds from 0.02 m and 1 on."""
_BESIDE, _ORDER = 0.02, 0.02
"""Distance (m) of objects that are next to each other (the claim holds up to 0.05 m); least one in an order."""
_NEAR, _STOREY = 0.35, 0.2
"""Largest centre distance, as a share of the lower width, and height (m), at which an object may stand on another."""
_SHARP = 0.1
"""Error (m) of positions below which single supports are distinguished."""
_LATER = 1e6
"""Added to what others are to come before."""


def _bound(
    first: Tensor, second: Tensor, axis: Tensor, only: Tensor, low: float | Tensor, high: float | Tensor = math.inf,
    stays: bool = False,
) -> Tensor:  # fmt: skip
    """(K * A, 8) constraints ``low <= axis . (position of first - position of second) <= high`` on K pairs.

    A row holds both objects, as scene * N + slot, the axis, both bounds (m), and whether the first object alone may be
    moved. Axes are (A, 3) for all pairs or (K, A, 3). Bounds are infinite where ``only`` (K, A) is False.
    """
    zero = torch.zeros_like(only, dtype=torch.float64)
    least, most = torch.where(only, zero + low, -math.inf), torch.where(only, zero + high, math.inf)
    pair = zero + first[:, None], zero + second[:, None]
    row = torch.stack([*pair, *axis.expand(*only.shape, 3).unbind(-1), least, most, zero + stays], dim=-1)
    return row.flatten(0, 1)


def constraints(claims: Sequence[Tensor], scenes: Scenes, error: Tensor) -> Tensor:
    """Constraints (K, 8) under which claims (:func:`claim_tables`) hold, with as few changes of supports and orders as
    possible at the deviation ``error`` (3,) of positions. Claims whose objects are not in the scene (yet) have none.
    """
    found = [error.new_zeros(0, 8)]
    for table, constrain in zip(claims, (_sides, _supports, _places), strict=True):
        found += constrain(scenes, table, error[:2].max() < _SHARP) if len(table) else []
    every = torch.cat(found)
    return every[torch.nonzero(torch.isfinite(every[:, 5:7]).any(dim=1))[:, 0]]


def _ordered(
    scenes: Scenes, rows: Tensor, members: Tensor, ordinal: Tensor, edge: Tensor, taken: Tensor | None = None
) -> tuple[Tensor, list[Tensor]]:
    """Slot (M,) of the one of ``members`` (M, N) that is meant (-1: none), and constraints that keep its rank. If
    it is the other object of the claim, ``taken`` (M,), its neighbour in the order is taken instead.
    """
    axis, slots = constant_on(_DIRECTIONS, rows.device)[edge][:, None], members.shape[1]
    along = (scenes.positions[rows] * axis).sum(dim=-1)
    order = torch.where(members, -along, torch.inf).argsort(dim=1, stable=True)
    count, rank = members.sum(dim=1), (ordinal - 1).clamp(0, slots - 1)

    def ranked(at: Tensor) -> Tensor:
        return order.gather(1, at.clamp(0, slots - 1)[:, None])[:, 0]

    there, place = torch.where(ordinal > 0, count >= ordinal.clamp(min=2), count == 1), rank
    if taken is not None:
        here, before, after = (along.gather(1, ranked(at)[:, None])[:, 0] for at in (rank, rank - 1, rank + 1))
        nearer = (rank > 0) & ((rank + 1 >= count) | ((before - here).abs() <= (after - here).abs()))
        other = torch.where(nearer, rank - 1, rank + 1)
        place = torch.where((ordinal > 0) & (ranked(rank) == taken), other, rank)
    start, known, chosen = rows * slots, there & (ordinal > 0), ranked(place)
    low, high = (start + ranked(at + (at >= place).long()) for at in (rank - 1, rank))
    return torch.where(there, chosen, -1), [
        _bound(low, start + chosen, axis, (known & (rank > 0))[:, None], _ORDER),
        _bound(start + chosen, high, axis, (known & (rank + 1 < count))[:, None], _ORDER),
    ]


def _holds(scenes: Scenes, rows: Tensor, unit: Tensor, tier: Tensor) -> Tensor:
    """(M, N) bool: objects at a place: slot of its unit (M,), or -1, and tier (M,), which may count from below."""
    tiers = torch.isfinite(scenes.levels[rows, unit.clamp(min=0)]).sum(dim=1)
    tier, whole = torch.where(tier < 0, tier + tiers, tier), (tier == _WHOLE)[:, None]
    on = (scenes.held.tier[rows] == tier[:, None]) & ((tier >= 0) & (tier < tiers))[:, None]
    return (scenes.held.place[rows] == unit[:, None]) & (unit >= 0)[:, None] & (whole | on)


def _refer(
    scenes: Scenes, rows: Tensor, told: Tensor, sharp: Tensor, taken: Tensor | None = None
) -> tuple[Tensor, list[Tensor]]:
    """Slot (M,) of the objects referred to in ``told`` (M, 7) (-1: none), and constraints that make this unambiguous:
    objects that are counted at a place move there as far as the reference needs them. ``taken``: see :func:`_ordered`.
    """
    names, (name, ordinal, edge, unit_name, unit_ordinal, unit_edge, tier) = scenes.names[rows], told.unbind(1)
    members, placed = names == name[:, None], unit_name != _NOWHERE
    unit, _ = _ordered(scenes, rows, names == unit_name[:, None], unit_ordinal, unit_edge)
    here = members & _holds(scenes, rows, unit, tier)
    count, needed = here.sum(dim=1), torch.where(ordinal > 0, ordinal.clamp(min=2), 1)
    short = torch.nonzero(placed & ((count < needed) | ((count > 1) & (ordinal == 0))))[:, 0]
    counted = torch.cat([torch.stack([rows, name, needed], dim=1), told[:, 3:]], dim=1)[short]
    found = _places(scenes, counted, sharp) if len(short) else []
    chosen, order = _ordered(scenes, rows, torch.where(placed[:, None], here, members), ordinal, edge, taken)
    return chosen, found + order


def _sides(scenes: Scenes, table: Tensor, sharp: Tensor) -> list[Tensor]:
    """Constraints of claims on two objects; both come to the furniture and tier of one of them."""
    rows, side, swapped = table[:, :3].unbind(1)
    start, held = rows * scenes.names.shape[1], scenes.held
    subject, found = _refer(scenes, rows, table[:, 3:10], sharp)
    landmark, more = _refer(scenes, rows, table[:, 10:], sharp, subject)
    known = (subject >= 0) & (landmark >= 0) & (subject != landmark)
    pair = start + subject.clamp(min=0), start + landmark.clamp(min=0)
    (place, other), (tier, level) = ([_at(column, each) for each in pair] for column in (held.place, held.tier))
    apart, swap = known & ((place != other) | (tier != level)), swapped.bool()
    swap = swap ^ (torch.where(swap, place, other) < 0)  # the landmark, or the subject, stays if it is on furniture
    unit, tier = start + torch.where(swap, place, other).clamp(min=0), torch.where(swap, tier, level)
    comes, levels = torch.where(swap, *pair[::-1]), _at(scenes.levels, unit)
    level = torch.where(tier >= 0, levels.gather(1, tier.clamp(min=0)[:, None])[:, 0], torch.nan)
    apart = apart & (comes != unit) & ~_at(scenes.fixed, comes)
    beside = side == _EDGES.index("next")
    reach = (_at(scenes.sizes, pair[0]) + _at(scenes.sizes, pair[1]))[:, :2] / 2 + _BESIDE
    ahead, only = constant_on(_DIRECTIONS, rows.device)[side], (known & ~beside)[:, None]
    across = torch.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], dim=1)
    cone = torch.stack([ahead - _CONE * across, ahead + _CONE * across], dim=1) / math.hypot(1.0, _CONE)
    return [
        *found, *more, _stand_at(scenes, comes, unit, level, apart),
        _bound(*pair, constant_on(_AXES, rows.device)[:2], (known & beside)[:, None].expand(-1, 2), -reach, reach),
        _bound(*pair, ahead[:, None], only, _OFFSET), _bound(*pair, cone, only.expand(-1, 2), 0.0),
    ]  # fmt: skip


def _supports(scenes: Scenes, table: Tensor, sharp: Tensor) -> list[Tensor]:
    """Constraints of claims on a number of objects on or in one object, or each on or in one of a name."""
    rows, name, number, inside, pair, under_name = table[:, :6].unbind(1)
    names, inside, pair = scenes.names[rows], inside.bool()[:, None], pair.bool()[:, None]
    start, numbers = rows * names.shape[1], torch.arange(names.shape[1], device=rows.device)
    landmark, found = _refer(scenes, rows, table[:, 5:], sharp)
    supports = torch.where(pair, names == under_name[:, None], numbers == landmark[:, None])
    members, apart = names == name[:, None], scenes.distances(rows)
    standing = torch.where(scenes.held.contained, -1, scenes.held.support)[rows]
    holder = torch.where(inside, scenes.held.inside[rows], standing)

    def among(slot: Tensor) -> Tensor:
        return members & supports.gather(1, slot.clamp(min=0)) & (slot >= 0)

    # while heights are uncertain, an object is taken to stand on the highest of the objects below its middle
    height, width = scenes.low[rows, :, 2], scenes.sizes[rows, :, :2].amax(dim=-1)
    above = height[:, :, None] - height[:, None]
    below = (apart < _NEAR * width[:, None]) & (above > 0.0) & (above < _STOREY) & (names >= 0)[:, None]
    least, likely = torch.where(below, above, torch.inf).min(dim=-1)
    changed = ~among(holder) & ~inside & (least < torch.inf) & among(likely) & sharp
    holder = torch.where(changed, likely, holder)

    kept = among(holder)
    missing = torch.where(supports.any(dim=1) & members.any(dim=1), number - kept.sum(dim=1), 0)
    bears = _marked(holder) | _marked(scenes.held.support[rows])
    key = _LATER * bears - apart.gather(2, holder.clamp(min=0)[..., None])[..., 0]
    removed = _first(kept, key, torch.where(sharp, -missing, 0))
    free, kept = members & ~kept, kept & ~removed & ((missing >= 0) | sharp)[:, None]
    short = torch.nonzero((missing > 0) & free.any(dim=1))[:, 0]
    if len(short):
        alone = pair & ~inside  # only containers, and the landmark of a claim, support several
        lower = supports & ~(alone & (_marked(holder) | _marked(standing)))
        pairs = free[:, :, None] & lower[:, None] & (holder[:, None] != numbers[:, None]) & ~scenes.carried[rows]
        order = torch.where(pairs, apart, torch.inf)[short], (width[:, :, None] - width[:, None])[short]
        under = _closest_pairs(*order, alone[short], missing[short])
        holder[short] = torch.where(under >= 0, under, holder[short])
        kept[short] |= under >= 0
    claim, upper = torch.nonzero(kept, as_tuple=True)
    found.append(_stand_on(scenes, start[claim] + upper, start[claim] + holder[claim, upper], inside[claim, 0]))
    claim, upper = torch.nonzero(removed, as_tuple=True)
    return [*found, _stand_beside(scenes, rows[claim], upper, holder[claim, upper])] if len(claim) else found


def _closest_pairs(apart: Tensor, wider: Tensor, alone: Tensor, number: Tensor) -> Tensor:
    """(M, N) the object under each object, -1 for none, in ``number`` (M,) pairs, the closest ones first.

    Pairs of an upper and a lower object are ``apart`` (M, N, N), m, or inf if they may not be. The upper one is
    ``wider`` (M, N, N), m; of two orders of a pair the wider object is below. Every object stands on one other at
    most, and where ``alone`` (M, 1), it carries one at most.
    """
    slots = apart.shape[1]
    claim, numbers = (torch.arange(size, device=apart.device) for size in apart.shape[:2])
    under = torch.full_like(apart[:, 0], -1, dtype=torch.int64)
    over = torch.eye(slots, dtype=torch.bool, device=apart.device).repeat(len(apart), 1, 1)  # what is below each object
    for done in range(slots):
        least = apart.flatten(1).amin(dim=1)
        going = torch.nonzero((least < torch.inf) & (number > done))[:, 0]
        state = (claim, apart, wider, alone, number, over, least)
        claim, apart, wider, alone, number, over, least = (column[going] for column in state)
        if not len(going):
            break
        best = torch.where(apart == least[:, None, None], wider, torch.inf).flatten(1).argmin(dim=1)
        row, upper, lower = torch.arange(len(claim), device=claim.device), best // slots, best % slots
        under[claim, upper] = lower
        over = over | (over[row, :, upper][:, :, None] & over[row, lower][:, None])
        taken = over.mT | (numbers == upper[:, None])[:, :, None] | ((numbers == lower[:, None]) & alone)[:, None]
        apart = apart.masked_fill(taken, torch.inf)
    return under


def _places(scenes: Scenes, table: Tensor, sharp: Tensor) -> list[Tensor]:
    """Constraints of claims on a number of objects at a place."""
    rows, name, number, unit_name, ordinal, edge, tier = table.unbind(1)
    names, slots, whole = scenes.names[rows], scenes.names.shape[1], (tier == _WHOLE)[:, None]
    start, members, units = (rows * slots)[:, None], names == name[:, None], names == unit_name[:, None]
    unit, found = _ordered(scenes, rows, units & members.any(dim=1, keepdim=True), ordinal, edge)
    here, base = members & _holds(scenes, rows, unit, tier), unit.clamp(min=0)
    missing, levels, apart = number - here.sum(dim=1), scenes.levels[rows, base], scenes.distances(rows)
    known = torch.isfinite(levels).sum(dim=1, keepdim=True)
    shelf = tier[:, None].remainder(known.clamp(min=1))
    height, level = scenes.low[rows, :, 2] - scenes.positions[rows, base, 2][:, None], levels.gather(1, shelf)
    from_unit = apart.gather(2, base[:, None, None].expand(-1, slots, 1))[..., 0]
    comes = _first(members & ~here, torch.where(whole, from_unit, (height - level).abs()), missing)
    others = levels.scatter(1, shelf, torch.nan)
    off, nearest = (height[..., None] - others[:, None]).abs().nan_to_num(torch.inf).min(dim=-1)
    leaves = _first(here, off, -missing) & ~whole & (known > 1)
    units &= torch.arange(slots, device=rows.device) != unit[:, None]
    away, other = torch.where(units[:, None], apart, torch.inf).min(dim=-1)
    key = away + _LATER * _marked(scenes.held.support[rows])
    changes = _first(here, key, -missing) & whole & units.any(dim=1, keepdim=True)
    level = torch.where(leaves, others.gather(1, nearest), torch.where(whole, torch.nan, level))
    to = start + torch.where(changes, other, unit[:, None])
    moving = (comes | leaves | changes) & (unit >= 0)[:, None] & (whole | (known > 0))
    claim, slot = torch.nonzero(moving, as_tuple=True)
    every = torch.ones_like(claim, dtype=torch.bool)
    return [*found, _stand_at(scenes, start[claim, 0] + slot, to[claim, slot], level[claim, slot], every)]


def _marked(slots: Tensor) -> Tensor:
    """(M, N) bool: which slots ``slots`` (M, N) names; -1 names none."""
    marks = torch.zeros(len(slots), slots.shape[1] + 1, dtype=torch.bool, device=slots.device)
    return marks.scatter(1, slots + 1, True)[:, 1:]


def _first(some: Tensor, key: Tensor, number: Tensor) -> Tensor:
    """(M, N) bool: of ``some`` (M, N), the ``number`` (M,) ones with the least ``key`` (M, N)."""
    rank = torch.where(some, key, torch.inf).argsort(dim=1, stable=True).argsort(dim=1)
    return some & (rank < number[:, None])


_AXES = torch.eye(3, dtype=torch.float64)
"""Right, front and up, the axes of positions."""
_UPON, _WITHIN = 0.15, 0.25
"""Share of an object's width within which the centre of what stands on it, or in it, lies to each side of its own."""
_LEVEL, _REST = 0.004, 0.01
"""Largest difference (m) of the heights of two objects in contact; height (m) above a tier of objects on it."""
_FLOOR, _FILL = 0.01, 0.03
"""Thickness (m) of the bottom of a container; height (m) above it within which the lowest objects lie."""
_CLEAR, _SPOT = 1.1, 0.03
"""Distance, over their mean width, of objects that no longer stand on each other, and how far (m) it may be missed."""
_OFF = 10.0
"""A place outside the furniture counts as less roomy by this factor times its distance."""
_ROUND = torch.arange(16, dtype=torch.float64) * math.pi / 8
_AROUND = torch.stack([_ROUND.cos(), _ROUND.sin()], dim=1)
"""Directions around an object."""


def _stand_on(scenes: Scenes, upper: Tensor, lower: Tensor, inside: Tensor) -> Tensor:
    """Constraints under which the objects ``upper`` (K,) stand on ``lower`` (K,), or lie in them."""
    reach = torch.where(inside, _WITHIN, _UPON)[:, None] * _at(scenes.sizes, lower)[:, :2]
    surface = torch.where(inside, _FLOOR - _at(scenes.foot, lower), _at(scenes.top, lower))
    height = (surface + _at(scenes.foot, upper))[:, None]
    most = height + _LEVEL + torch.where(inside, _FILL, 0.0)[:, None]
    low, high = torch.cat([-reach, height - _LEVEL], dim=1), torch.cat([reach, most], dim=1)
    return _bound(upper, lower, constant_on(_AXES, low.device), torch.ones_like(low, dtype=torch.bool), low, high)


def _stand_beside(scenes: Scenes, scene: Tensor, upper: Tensor, lower: Tensor) -> Tensor:
    """Constraints that move the objects ``upper`` (K,) of scenes from ``lower`` (K,) to the place next to it that is,
    on the same furniture, farthest from all other objects.
    """
    slots, support, numbers = (
        scenes.names.shape[1],
        scenes.held.support,
        torch.arange(scenes.names.shape[1], device=scene.device),
    )
    loose = (support >= 0) & ~scenes.fixed.gather(1, support.clamp(min=0))
    below = torch.where(loose, support, numbers)
    for _ in range(slots.bit_length()):
        below = below.gather(1, below)  # the lowest object of each stack
    sizes, middle = scenes.sizes[..., :2], scenes.positions[scene, lower]
    clear = _CLEAR * torch.cat([sizes[scene, upper], sizes[scene, lower]], dim=1).mean(dim=1, keepdim=True)
    places = middle[:, None, :2] + clear[..., None] * constant_on(_AROUND, scene.device)  # (K, 16, 2)
    others = (~scenes.fixed & (scenes.names >= 0))[scene] & (numbers != upper[:, None]) & (numbers != lower[:, None])
    room = (places[:, :, None] - scenes.positions[scene, None, :, :2]).norm(dim=-1)  # (K, 16, N)
    room = torch.minimum(torch.where(others[:, None], room, torch.inf).amin(dim=-1), clear)
    unit = scenes.held.place[scene, lower]
    low, high = (side[scene, unit.clamp(min=0), None, :2] for side in (scenes.low, scenes.high))
    outside = torch.maximum(low - places, places - high).amax(dim=-1).clamp(min=0.0)
    best = (room - _OFF * torch.where(unit[:, None] >= 0, outside, 0.0)).argmax(dim=1)
    height = scenes.low[scene, below[scene, lower], 2] + scenes.foot[scene, upper]
    goal = torch.cat([places.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0], height[:, None]], dim=1) - middle
    slack = torch.where(constant_on(_AXES, goal.device)[2] > 0, _LEVEL, _SPOT)
    pair, only = (scene * slots + upper, scene * slots + lower), torch.ones_like(goal, dtype=torch.bool)
    return _bound(*pair, constant_on(_AXES, goal.device), only, goal - slack, goal + slack, stays=True)


def _stand_at(scenes: Scenes, index: Tensor, unit: Tensor, level: Tensor, only: Tensor) -> Tensor:
    """Constraints that put objects (K,) in the outline of furniture ``unit`` (K,), ``level`` (K,) above its position,
    NaN for any height; bounds where ``only`` (K,).
    """
    margin, center = _at(scenes.sizes, index) / 2, _at(scenes.positions, unit)
    low, high = _at(scenes.low, unit) - center + margin, _at(scenes.high, unit) - center - margin
    low[:, 2] = level + _at(scenes.foot, index) - _LEVEL
    high[:, 2] = low[:, 2] + _LEVEL + _REST
    return _bound(index, unit, constant_on(_AXES, low.device), (low < high) & only[:, None], low, high, stays=True)
