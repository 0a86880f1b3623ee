"""Guidance of a reverse chain: hooks that change its steps, and guidance by physics and by numbers of objects.

Guidance of poses by the claims of prompts is in :mod:`agents.priors.claim_guidance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from agents.diffusion.categorical import one_hot
from agents.diffusion.reverse_steps import MixedStep, ReverseStep, state_of
from agents.priors.claim_guidance import claims_of, names_of
from scene_envs.arrays import constant_on
from scene_envs.datasets.prompts.claims import (
    Claim,
    NameCount,
    ObjectCount,
    PairCount,
    PlaceCount,
    Reference,
    SideClaim,
    SupportCount,
)
from scene_envs.envs.settings import check_physics_guidance
from scene_envs.physics.correction import FALL, corrections
from scene_envs.scene import POSE_FEATURES, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

Hook = Callable[[int, Tensor, ReverseStep], ReverseStep]
"""``(step, x_t, reverse) -> reverse``: called at every step before x_{t-1} is drawn; may change the rows of
``reverse`` or shift it.
"""
Guide = Callable[[int, int, Callable[[], SceneBatch], Tensor], Tensor | None]
"""``(step, steps, denoised, std) -> shift``: moves the denoised translations by ``shift`` (B, N, 3), m.

``denoised()`` gives the B scenes that the network expects at this step; ``std`` (3,) is the standard deviation of the
denoised translations, m, on their device. If the shift is None, the step is not changed. If a guide has a method
``acts(std)``, it is called only at the steps at which the method, which gets ``std`` on the CPU, returns True.
"""


_FINE = 0.03
"""Error (m) of horizontal positions below which objects are moved; above it, overlaps are not known yet."""
_LAST_ROUNDS = 2
"""Further rounds at the last step, in which a metre costs the same along every axis."""
_LAST_FALL = 0.3
"""Height (m) above others from which objects come down at the last step, about that of three missing steamers."""


class PhysicsGuidance:
    """Moves the objects of each scene out of overlaps and onto supports, at the last steps of the denoising.

    From the step on at which the horizontal error of the denoised positions is below 3 cm, objects that overlap in the
    denoised scene come apart, and floating ones come down, by ``strength`` times the moves of
    :func:`~scene_envs.physics.correction.corrections`. The following steps adapt the scene to the moves. At the last
    step the moves change the sample itself, further rounds take apart what one round has left, and objects that float
    up to 30 cm above others come down, as where a piece of a stack is missing.

    Args:
        strength: factor on the moves, 0 to 1.
        movable: (B, N) bool, slots whose poses are denoised; None for all but the fixed ones.

    >>> import torch
    >>> guidance = PhysicsGuidance(1.0)
    >>> guidance(49, 50, lambda: SceneBatch.empty("dimsum_table", 1), torch.full((3,), 0.001)).abs().max()
    tensor(0.)
    """

    def __init__(self, strength: float, movable: Tensor | None = None) -> None:
        self.strength = strength
        self._movable = movable

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor:
        """(B, N, 3) m, how far the denoised positions move.

        Args:
            step, steps: number of the step, from 0, and of all steps.
            denoised: function that gives the B scenes that the network expects.
            std: (3,) standard deviation of their positions along the axes of the world, m.
        """
        scenes = denoised()
        rounds, fall = (_LAST_ROUNDS, _LAST_FALL) if step == steps - 1 else (0, FALL)
        moves = corrections(scenes, std, self._movable, fall)
        for _ in range(rounds):
            moved = scenes.with_poses(scenes.translations + moves, scenes.rotations)
            moves = moves + corrections(moved, torch.ones_like(std), self._movable, fall)
        return self.strength * moves

    @staticmethod
    def acts(std: Tensor) -> bool:
        """Whether objects are moved at steps whose denoised positions have the standard deviation ``std`` (3,), m."""
        return float(std[:2].max()) <= _FINE


_ROUNDS = 50
"""Rounds of iterative scaling; numbers are then within a few thousandths of their bounds."""
_MAX_FACTOR = 1e9
"""Largest factor on a probability, and the inverse of the smallest."""
_SAME = 1e-6
"""Difference of a factor from 1 below which it changes nothing."""
_TINY = 1e-12
Bounds = dict[str, tuple[float, float]]
"""Least and largest number of objects of each display name; the name "" stands for all objects."""


class NumberGuidance:
    """Draws categories so that each scene holds the numbers of objects that its prompt claims.

    Expected final count of a kind = its unmasked objects + its summed probability over masked slots. Where it is
    outside the bounds that the claims put on it, the probabilities of the kind are multiplied by one factor for all
    slots, so that it comes to the nearest bound. Of all distributions with these expectations this one has the least
    divergence from that of the prior (Csiszar 1975). The chance of a slot to be unmasked stays as it is. Kinds with a
    factor, or with one number as bounds, are drawn by systematic sampling (:mod:`agents.diffusion.categorical`).

    Steps of continuous priors, and of categories that are replaced or unmasked independently, are not changed.

    Args:
        prompts: B texts. Text that cannot be read makes no claims.
        scene_type: scene type of the scenes.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed", text=True, kernel="squared_absorbing")
    >>> batch = prior.sample(2, prompt="A scene with 12 cups.", claim_guidance=1.0, num_steps=20)
    >>> [names.count("teacup") for names in batch.names()]
    [12, 12]
    """

    def __init__(self, prompts: Sequence[str], scene_type: str | SceneType) -> None:
        kinds, of_asset = names_of(get_scene_type(scene_type).library)
        self._kinds = F.pad(of_asset, (0, 1), value=len(kinds))  # (K,); *empty* is a kind of its own, the last
        self._bounds = [number_bounds(claims_of(prompt, scene_type)) for prompt in prompts]
        self._names = [*kinds, ""]
        self._member = F.one_hot(self._kinds, len(self._names)).double()  # (K, R)
        self._limits: dict[int, tuple[Tensor, Tensor]] = {}

    def __call__(self, x: Tensor, reverse: ReverseStep) -> ReverseStep:
        """The step at x_t (B, N, D) with other probabilities of the masked slots' categories."""
        if not isinstance(reverse, MixedStep) or reverse.masked is None:
            return reverse
        if reverse.masked.device.type == "cpu" and not reverse.masked.any():
            return reverse
        masked, states = reverse.masked, state_of(x[..., POSE_FEATURES:])
        kinds, member = (constant_on(table, x.device) for table in (self._kinds, self._member))
        probs, chance = reverse.probs[..., :-1], 1 - reverse.probs[..., -1:]
        drawn = torch.where(masked[..., None], probs.double(), 0.0) @ member / chance.clamp(min=_TINY).double()
        visible = one_hot(states, len(kinds), torch.float64).sum(dim=1) @ member
        low, high = (constant_on(bound, x.device) - visible for bound in self._limits_of(x.shape[1]))
        weights = kind_weights(drawn, low.clamp(min=0.0), high.clamp(min=0.0))  # (B, R)
        tilted = probs * weights[:, kinds].unsqueeze(1).to(probs)
        tilted = tilted * (chance / tilted.sum(dim=-1, keepdim=True).clamp(min=_TINY))
        changed = (weights - 1).abs() > _SAME
        tilted = torch.where(masked[..., None] & changed.any(dim=-1)[:, None, None], tilted, probs)
        together = ((low == high) | changed)[:, kinds]
        groups = torch.where(together, kinds + 2 * len(kinds), -1 if reverse.groups is None else reverse.groups)
        return reverse._replace(probs=torch.cat([tilted, reverse.probs[..., -1:]], dim=-1), groups=groups)

    def _limits_of(self, slots: int) -> tuple[Tensor, Tensor]:
        """(B, R) least and largest number of each kind, in scenes of ``slots``."""
        if slots not in self._limits:
            low = torch.zeros(len(self._bounds), len(self._names), dtype=torch.float64)
            high = torch.full_like(low, torch.inf)
            for row, bounds in enumerate(self._bounds):
                for name, (least, most) in bounds.items():
                    if not name:
                        least, most = slots - most, slots - least
                    kind = self._names.index(name)
                    low[row, kind], high[row, kind] = max(least, 0.0), max(most, 0.0)
            self._limits[slots] = low, high
        return self._limits[slots]


def kind_weights(probs: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """(B, R) factors on the probabilities of R kinds that bring expected numbers within their bounds.

    Bounds that cannot all be met are approached in proportion.

    Args:
        probs: (B, N, R) probabilities of the kinds in each slot; slots that are not drawn have none.
        low, high: (B, R) least and largest sum over the slots.

    >>> probs = torch.tensor([[[0.5, 0.5], [0.25, 0.75]]], dtype=torch.float64)
    >>> weights = kind_weights(probs, torch.tensor([[1.0, 0.0]]), torch.tensor([[1.0, 9.0]]))
    >>> tilted = probs * weights
    >>> round((tilted / tilted.sum(dim=-1, keepdim=True))[..., 0].sum().item(), 6)
    1.0
    """
    low, high = low.to(probs), high.to(probs)
    slots = probs.sum(dim=(1, 2))[:, None]
    weights, rest = torch.ones_like(low), torch.ones_like(slots)  # rest: factor of the kinds within their bounds
    for _ in range(_ROUNDS):
        tilted = probs * weights.unsqueeze(1)
        number = (tilted / tilted.sum(dim=-1, keepdim=True).clamp(min=_TINY)).sum(dim=1)
        expected = number * rest / weights.clamp(min=_TINY)  # near the solution, without the factor of the kind
        target = torch.minimum(torch.maximum(expected, low), high)
        bound = target != expected
        left = (slots - torch.where(bound, target, 0.0).sum(dim=1, keepdim=True)).clamp(min=0.0)
        others = torch.where(bound, 0.0, number).sum(dim=1, keepdim=True)
        rest = (rest * left / others.clamp(min=_TINY)).clamp(1 / _MAX_FACTOR, _MAX_FACTOR)
        scaled = (weights * target / number.clamp(min=_TINY)).clamp(1 / _MAX_FACTOR, _MAX_FACTOR)
        weights = torch.where(bound, scaled, rest)
    return weights / rest


def number_bounds(claims: Sequence[Claim]) -> Bounds:
    """Bounds on the numbers of objects under which ``claims`` can hold.

    >>> from scene_envs.datasets import parse_prompt
    >>> prompt = "A scene where the teapot is behind the second cup from the left."
    >>> number_bounds(parse_prompt(prompt, "dimsum_table").claims)
    {'teapot': (1, 1), 'cup': (2, inf)}
    """
    found: Bounds = {}
    for claim in claims:
        for name, least, most in _bounds_of(claim):
            low, high = found.get(name, (0.0, math.inf))
            found[name] = max(low, least), min(high, most)
    return found


def _bounds_of(claim: Claim) -> Iterator[tuple[str, float, float]]:
    if isinstance(claim, ObjectCount):
        yield "", claim.number, claim.number
    elif isinstance(claim, NameCount):
        yield claim.name, claim.number, claim.number
    elif isinstance(claim, PlaceCount):
        yield claim.name, claim.number, math.inf
        yield from _of_reference(claim.place.unit)
    elif isinstance(claim, SupportCount):
        yield claim.name, claim.number + (claim.name == claim.landmark.name), math.inf
        yield from _of_reference(claim.landmark)
    elif isinstance(claim, PairCount):
        under = min(claim.number, 1) if claim.inside else claim.number
        yield claim.under, under, math.inf
        yield claim.name, claim.number + (claim.name == claim.under and claim.number > 0), math.inf
    elif isinstance(claim, SideClaim):
        for reference in (claim.subject, claim.landmark):
            yield from _of_reference(reference)


def _of_reference(reference: Reference) -> Iterator[tuple[str, float, float]]:
    """Count bounds that a reference implies: exactly one, or at least its ordinal."""
    if reference.place is not None:
        yield from _of_reference(reference.place.unit)
    only = not reference.ordinal and reference.place is None
    yield reference.name, max(2, reference.ordinal) if reference.ordinal else 1, 1 if only else math.inf


def physics_strength(given: float | None, config: Any, scene_type: SceneType) -> float:
    """The strength that a caller gives, or else that of a prior's configuration.

    Raises:
        InvalidInputError: not from 0 to 1, or the assets have no geometry.
    """
    strength = config.physics_guidance if given is None else given
    check_physics_guidance(strength, scene_type)
    return float(strength)
