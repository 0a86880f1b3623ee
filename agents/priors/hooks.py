"""Hooks of a reverse chain: what watches, guides or replaces scenes while they are denoised."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from agents.diffusion.reverse_steps import ReverseStep
from agents.diffusion.step_tables import StepTable
from scene_envs.normalizer import Normalizer
from scene_envs.scene import TRANSLATION, SceneBatch

Hook = Callable[[int, Tensor, ReverseStep], ReverseStep]
"""``(step, x_t, reverse) -> reverse``: called at every step before x_{t-1} is drawn; may change the rows of
``reverse`` or shift it.
"""
Start = tuple[int, Tensor]
"""A step of a chain, and x_t (B, N, D) at this step. The chain begins there instead of at x_T."""
Guide = Callable[[int, int, Callable[[], SceneBatch], Tensor], Tensor | None]
"""``(step, steps, denoised, std) -> shift``: moves the denoised translations by ``shift`` (B, N, 3), m.

``denoised`` is as for :data:`Watch`; ``std`` (3,) is the standard deviation of the denoised translations, m. If the
shift is None, the step is not changed.
"""
Draw = Callable[[Tensor, ReverseStep], ReverseStep]
"""``(x_t, reverse) -> reverse``: changes how the categories of masked slots are drawn."""
Watch = Callable[[int, int, Callable[[], SceneBatch]], Tensor | None]
"""``(step, steps, denoised) -> rows``: called at the steps of the denoising; chooses the scenes that continue.

``denoised()`` gives the B scenes that the network expects at this step. ``rows`` (B,) is the index of the scene that
each place continues with, such as ``[0, 0, 2]``; if it is None, every scene continues in its own place.

If a watch has a method ``start(steps)``, the chain begins at the :data:`Start` that the method returns, if any. If a
watch has a method ``see(step, steps, x)``, the method is called with x_t (B, N, D) at every step.
"""


class Estimating(Protocol):
    """A prior, as far as hooks need it."""

    normalizer: Normalizer

    def estimate(self, step: int, table: StepTable) -> tuple[float, Tensor]:
        """Weight of the denoised translations in x_{t-1}, and their standard deviation (3,), normalised."""


def make_hook(
    prior: Estimating,
    table: StepTable,
    scenes: Callable[[Tensor], SceneBatch],
    moved: Tensor,
    *,
    watch: Watch | None = None,
    guides: Sequence[Guide] = (),
    draw: Draw | None = None,
) -> Hook | None:
    """The hook of one chain; None if nothing watches or guides it.

    Args:
        prior: that denoises.
        table: the chain.
        scenes: the B scenes of normalised x_0 (B, N, D), as watch and guides see them.
        moved: (B, N, 1) bool, slots whose poses guides may move.
        watch, guides, draw: called in this order: ``watch.see``, ``draw``, guides, ``watch``.
    """
    see = getattr(watch, "see", None)

    def hook(step: int, x: Tensor, reverse: ReverseStep) -> ReverseStep:
        estimate = reverse.denoised
        if see is not None:
            see(step, len(table), x)
        if draw is not None:
            reverse = draw(x, reverse)
        if estimate is None:
            return reverse

        def denoised() -> SceneBatch:
            return scenes(estimate)

        if guides:
            weight, std = prior.estimate(step, table)
            scale = prior.normalizer.scale[TRANSLATION].to(std)
            metres = _in_metres(std, scale)
        for guide in guides:
            shift = guide(step, len(table), denoised, metres)
            if shift is not None:
                reverse = reverse.shifted(weight * scale * shift.to(std) * moved.to(std))
        rows = None if watch is None else watch(step, len(table), denoised)
        return reverse if rows is None else reverse.take(rows.to(x.device))

    return None if watch is None and draw is None and not guides else hook


def position_std(prior: Estimating, step: int, table: StepTable) -> Tensor:
    """(3,) standard deviation of the denoised positions at a step of a chain, m; 0 on axes without extent."""
    _, std = prior.estimate(step, table)
    return _in_metres(std, prior.normalizer.scale[TRANSLATION].to(std))


def _in_metres(std: Tensor, scale: Tensor) -> Tensor:
    """(3,) deviations in metres of normalised ones; 0 where ``scale`` (3,) is 0."""
    return torch.where(scale == 0, torch.zeros_like(scale), std / scale)
