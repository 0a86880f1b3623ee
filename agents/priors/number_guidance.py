"""Number guidance: denoising whose categories are drawn in the numbers that a prompt claims."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from agents.diffusion.reverse_steps import MixedStep, ReverseStep, state_of
from agents.priors.claim_constraints import claims_of
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
from scene_envs.scene import POSE_FEATURES
from scene_envs.scene_types import SceneType, get_scene_type

_ROUNDS = 50
"""Rounds of iterative scaling; numbers are then within a few thousandths of their bounds."""
_LARGEST = 1e9
"""Largest factor on a probability, and the inverse of the smallest."""
_SAME = 1e-6
"""A factor this close to 1 changes nothing."""
_TINY = 1e-12
Bounds = dict[str, tuple[float, float]]
"""Least and largest number of objects of each display name; the name "" stands for all objects."""


class NumberGuidance:
    """Draws categories so that each scene holds the numbers of objects that its prompt claims.

    At a step, the visible objects of a kind and the sum of its probabilities over the masked slots are the number that
    is expected in the end. Where this number is outside the bounds that the claims put on it, the probabilities of the
    kind are multiplied by one factor for all slots, so that it comes to the nearest bound. Of all distributions with
    these expectations this one has the least divergence from that of the prior (Csiszar 1975). The chance of a slot to
    be unmasked stays as it is. Kinds with a factor, or with one number as bounds, are drawn by systematic sampling
    (:mod:`agents.diffusion.unmasking`).

    Steps of continuous priors, and of categories that are replaced or unmasked independently, are not changed.

    Args:
        prompts: B texts. Text that cannot be read makes no claims.
        scene_type: of the scenes.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed", text=True, kernel="squared_absorbing")
    >>> batch = prior.sample(2, prompt="A scene with 12 cups.", claim_guidance=1.0, num_steps=20)
    >>> [names.count("teacup") for names in batch.names()]
    [12, 12]
    """

    def __init__(self, prompts: Sequence[str], scene_type: str | SceneType) -> None:
        library = get_scene_type(scene_type).library
        kinds: dict[str, int] = {}
        of_asset = [kinds.setdefault(asset.display_name, len(kinds)) for asset in library]
        self._kinds = torch.tensor([*of_asset, len(kinds)])  # (K,); *empty* is a kind of its own, the last
        self._bounds = [number_bounds(claims_of(prompt, scene_type)) for prompt in prompts]
        self._names = [*kinds, ""]
        self._member = F.one_hot(self._kinds, len(self._names)).double()  # (K, R)
        self._limits: dict[int, tuple[Tensor, Tensor]] = {}

    def __call__(self, x: Tensor, reverse: ReverseStep) -> ReverseStep:
        """The step at x_t (B, N, D) with other probabilities of the masked slots' categories."""
        if not isinstance(reverse, MixedStep) or reverse.masked is None or not bool(reverse.masked.any()):
            return reverse
        masked, kinds, states = reverse.masked, self._kinds.to(x.device), state_of(x[..., POSE_FEATURES:])
        probs, chance = reverse.probs[..., :-1], 1 - reverse.probs[..., -1:]
        member = self._member.to(x.device)
        drawn = torch.where(masked[..., None], probs.double(), 0.0) @ member / chance.clamp(min=_TINY).double()
        visible = F.one_hot(states, len(kinds) + 1)[..., :-1].sum(dim=1).double() @ member
        low, high = (bound.to(visible) - visible for bound in self._limits_of(x.shape[1]))
        weights = kind_weights(drawn, low.clamp(min=0.0), high.clamp(min=0.0))  # (B, R)
        tilted = probs * weights[:, kinds].unsqueeze(1).to(probs)
        tilted = tilted * (chance / tilted.sum(dim=-1, keepdim=True).clamp(min=_TINY))
        changed = (weights - 1).abs() > _SAME
        tilted = torch.where(masked[..., None] & changed.any(dim=-1)[:, None, None], tilted, probs)
        together = ((low == high) | changed)[:, kinds]
        others = torch.full_like(self._kinds, -1).expand(len(x), -1) if reverse.groups is None else reverse.groups
        groups = torch.where(together, kinds + 2 * len(kinds), others.to(x.device))
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
        rest = (rest * left / others.clamp(min=_TINY)).clamp(1 / _LARGEST, _LARGEST)
        scaled = (weights * target / number.clamp(min=_TINY)).clamp(1 / _LARGEST, _LARGEST)
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
    """One thing of the name and no other, or as many as an order or a place needs."""
    if reference.place is not None:
        yield from _of_reference(reference.place.unit)
    only = not reference.ordinal and reference.place is None
    yield reference.name, max(2, reference.ordinal) if reference.ordinal else 1, 1 if only else math.inf
