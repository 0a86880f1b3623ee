"""Claim guidance: denoising whose poses are moved toward the claims of a prompt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch
from scipy.special import log_ndtr, ndtr
from torch import Tensor

from agents.priors.claim_constraints import claims_of, constraints
from agents.priors.pair_constraints import Constraint, Surfaces
from scene_envs.arrays import Array, Index, Mask
from scene_envs.assets import AssetLibrary
from scene_envs.assets.support_shapes import library_shapes
from scene_envs.datasets.prompts import Tolerances, scene_facts
from scene_envs.datasets.prompts.facts import SceneFacts, viewer_axes
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType
from scene_envs.supports import CONTACT, LARGEST_CONTACT

_FINEST = 0.02
"""Error (m) of positions below which nothing is moved: the denoising that is left separates objects again."""
_SHALLOW = 0.02
"""Depth (m) of a plate: up to it, things stand on the middle of a thing and not on its rim."""
_UPRIGHT = 0.85
"""Cosine of the tilt up to which a thing carries others on its upper side."""


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
        scene_type: of the scenes.
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
            step, steps: not used.
            denoised: gives the B scenes that the network expects.
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
                moves[row, scene.slots] = self._moves(wanted, scene, error, self._free(batch, row, scene)) @ self._axes
        return torch.as_tensor(moves, dtype=batch.tensor.dtype, device=std.device)

    def _free(self, batch: SceneBatch, row: int, scene: SceneFacts) -> Mask:
        """(n,) bool: objects that may move."""
        free: Mask = scene.slots >= len(batch.scene_type.fixed)
        return free if self._movable is None else free & self._movable[row, scene.slots]

    def _moves(self, wanted: Sequence[Constraint], scene: SceneFacts, error: Array, free: Mask) -> Array:
        """(n, 3) m, in the frame of ``scene``: the sum of the moves for M constraints."""
        if not wanted:
            return np.zeros((scene.count, 3))
        first, second = (np.array([getattr(c, name) for c in wanted]) for name in ("first", "second"))
        low, high = (np.array([getattr(c, name) for c in wanted]) for name in ("low", "high"))
        stays = np.array([c.second_stays for c in wanted])
        axis = np.stack([c.axis for c in wanted])  # (M, 3)
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
    flat = upright & (middle + origin > highest - _SHALLOW)  # not so of a hollow thing, whose rim carries others
    top = np.where(flat, middle + origin, highest)
    return Surfaces(top, shapes.tiers[categories] + origin[:, None])


@lru_cache(maxsize=32)
def _middles(library: AssetLibrary) -> Array:
    """(C,) height of the upper side of each asset at its middle, asset frame, m; -inf where nothing is."""
    shapes = library_shapes(library)
    every = np.arange(len(shapes.top))
    return np.asarray(shapes.top[shapes.cells(every, np.zeros((len(every), 3)))])
