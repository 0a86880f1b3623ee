"""Claim guidance: denoising whose poses are moved toward the claims of a prompt."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import torch
from scipy.special import log_ndtr, ndtr
from torch import Tensor

from agents.priors.claim_constraints import constraints
from agents.priors.pair_constraints import Constraint, Surfaces
from scene_envs.arrays import Array, Mask
from scene_envs.assets.support_shapes import library_shapes
from scene_envs.datasets.prompts import Tolerances, parse_prompt, scene_facts
from scene_envs.datasets.prompts.claims import Claim
from scene_envs.datasets.prompts.facts import SceneFacts, viewer_axes
from scene_envs.errors import InvalidInputError
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
        self._claims = [_claims(prompt, scene_type) for prompt in prompts]
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
        """(n, 3) m, in the frame of ``scene``."""
        moves = np.zeros((scene.count, 3))
        carried = _carried(scene)
        for constraint in wanted:
            first = _without(carried, constraint.first, constraint.second)
            second = _without(carried, constraint.second, constraint.first)
            sides = [(who & free, sign) for who, sign in ((first, 1.0), (second, -1.0)) if (who & free).any()]
            uncertain = len(sides)
            sides = [side for side in sides if side[1] > 0] if constraint.second_stays else sides
            if not sides:
                continue
            offset = scene.positions[constraint.first] - scene.positions[constraint.second]
            spread = np.sqrt(uncertain) * float(np.linalg.norm(constraint.axis * error))
            slope = probability_slope(float(constraint.axis @ offset), constraint.low, constraint.high, spread)
            step = uncertain / len(sides) * self.strength * slope * error**2 * constraint.axis
            for who, sign in sides:
                moves[who] += sign * step
        return moves


def probability_slope(value: float, low: float, high: float, spread: float) -> float:
    """d ln P(low <= x <= high) / d value, 1/m, of a normal x with mean ``value`` and standard deviation ``spread``, m.

    The mean of x given that it lies in the interval is ``value + spread² * slope``.

    >>> round(probability_slope(0.0, 0.0, np.inf, 1.0), 6)  # sqrt(2 / pi): the mean of a half-normal
    0.797885
    >>> probability_slope(-50.0, 0.0, 0.5, 1.0) > 50.0      # far outside: to the nearest bound and a little beyond
    True
    """
    below, above = (low - value) / spread, (high - value) / spread
    if below > 0:  # the same by symmetry; keeps the digits of a small probability
        return -probability_slope(-value, -high, -low, spread)
    if above < 0:
        upper, lower = log_ndtr(above), log_ndtr(below)
        log_mass = upper + np.log1p(-np.exp(lower - upper))
    else:
        log_mass = np.log(ndtr(above) - ndtr(below))
    densities = [
        0.0 if np.isinf(z) else np.exp(-0.5 * z * z - 0.5 * np.log(2 * np.pi) - log_mass) for z in (below, above)
    ]
    return float((densities[0] - densities[1]) / spread)


def _carried(scene: SceneFacts) -> Mask:
    """(n, n) bool: [i, j] whether object j is i, or is held by i, directly or through others."""
    carried: Mask = np.eye(scene.count, dtype=bool)
    for upper in range(scene.count):
        lower = int(scene.held.support[upper])
        while lower >= 0 and not carried[lower, upper]:
            carried[lower, upper] = True
            lower = int(scene.held.support[lower])
    return carried


def _without(carried: Mask, who: int, other: int) -> Mask:
    """(n,) bool: what moves with object ``who``, without ``other`` and what is on it."""
    moving: Mask = carried[who] & ~carried[other] if carried[who, other] else carried[who]
    return moving


def _surfaces(batch: SceneBatch, row: int, scene: SceneFacts) -> Surfaces:
    """Surfaces of the objects of one scene that carry others."""
    shapes = library_shapes(batch.scene_type.library)
    categories = batch.categories[row].numpy()[scene.slots]
    origin = batch.translations[row, :, 2].double().numpy()[scene.slots] - scene.positions[:, 2]
    upright = batch.rotations[row, :, 2, 2].numpy()[scene.slots] > _UPRIGHT
    middle = shapes.top[shapes.cells(categories, np.zeros((len(categories), 3)))]
    highest = scene.boxes[:, 1, 2] - scene.positions[:, 2]
    flat = upright & (middle + origin > highest - _SHALLOW)  # not so of a hollow thing, whose rim carries others
    top = np.where(flat, middle + origin, highest)
    return Surfaces(top, shapes.tiers[categories] + origin[:, None])


@lru_cache(maxsize=4096)
def _claims(prompt: str, scene_type: str | SceneType) -> tuple[Claim, ...]:
    """The claims of a prompt; none where it cannot be read."""
    try:
        return parse_prompt(prompt, scene_type).claims if prompt.strip() else ()
    except InvalidInputError:
        return ()
