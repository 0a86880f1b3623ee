"""Regularisation of a run: its loss, its weight, and the factor on the weight that holds a target."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.networks.text import Text
from agents.post_training.algorithms.base import gradient_norm, in_parts
from agents.post_training.real_scenes import PromptedScenes
from agents.post_training.settings import RegularisationSettings
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.utils.process_group import ProcessGroup

logger = logging.getLogger(__name__)

SHARPNESS = 20.0
"""Scale of the discriminative loss; with a larger value the prior moves less far from its base."""
MIN_FACTOR, MAX_FACTOR = 0.01, 100.0
"""Bounds of the factor on the weight."""
GAIN = 0.05
"""Change of the factor's logarithm per iteration if the figure's excess over its base value is twice the target's."""
LOOK_AHEAD = 30.0
"""Iterations by which a measurement is extrapolated, because the weights act with a delay."""
SMOOTHING = 10.0
"""Iterations over which the figure's change per iteration is averaged."""
MAX_ERROR = 3.0
"""Bound of the relative error that the factor follows."""
MAX_FINAL_ERROR = 0.5
"""Relative error of the last measurement above which the target counts as not held at the end."""
PATIENCE = 3
"""Measurements in a row above the target, with the factor at its upper bound, after which the target is not held."""

SceneLoss = Callable[[NoisedScenes, Text | None], Tensor]
"""(B,) losses of noised scenes and their prompts."""


class Regularisation:
    """The loss that keeps a prior in training near real scenes, and its weight; the base ``prior`` is copied if
    needed.
    """

    def __init__(self, settings: RegularisationSettings, prior: ScenePrior) -> None:
        self.settings = settings
        self.state = HoldState()
        compares = settings.objective == "discriminative"
        self.base = deepcopy(prior).eval().requires_grad_(False) if compares else None

    @property
    def weight(self) -> float:
        """Coefficient of the pretraining loss on real scenes."""
        return (self.settings.weight or 0.0) * self.state.factor

    def accumulate(
        self,
        prior: ScenePrior,
        real: PromptedScenes,
        base: PromptedScenes | None,
        generator: Generator,
        chunk: int | None,
    ) -> dict[str, float]:
        """Add the gradient of the loss on ``real`` scenes of all processes, and on equally many ``base`` samples
        (discriminative loss only); returns columns of the log. Both get the same timesteps and noise from ``generator``
        (CPU). ``chunk`` is the number of scenes per pass.
        """

        parts: dict[str, tuple[PromptedScenes, SceneLoss | None]] = {"pretraining": (real, None)}
        if base is not None and self.base is not None:
            loss = DiscriminativeLoss(prior, self.base, SHARPNESS)
            parts = {"pretraining": (real, loss.of_real), "base_sample": (base, loss.of_base)}
        row, begun = {}, generator.get_state()
        for name, (scenes, of) in parts.items():
            row[f"{name}_loss"], row[f"{name}_gradient_norm"] = add_regularisation_gradient(
                prior, scenes.scenes, self.weight, generator.set_state(begun), loss=of, chunk=chunk,
                prompts=scenes.prompts,
            )  # fmt: skip
        if self.settings.hold is not None:
            row |= {"regularisation_weight": self.weight, "hold_factor": self.state.factor}
        return row

    def observe(self, ratio: float, iteration: int) -> None:
        """Adjust the weight after a check of the guard, whose held-out loss is ``ratio`` times the base prior's."""
        if self.settings.hold is None:
            return
        held = self.state.lost_at is None
        self.state = adjust(self.state, self.settings.hold, ratio, iteration)
        if held and self.state.lost_at is not None:
            logger.warning("%s", self.verdict())

    def return_to_checkpoint(self, ratio: float) -> None:
        """Keep the weight, and forget how the held-out loss changed before a return to a checkpoint, whose held-out
        loss is ``ratio`` times the base prior's.
        """
        self.state = replace(self.state, measured=ratio, slope=0.0)

    def verdict(self) -> str:
        """One sentence that says whether the target was held; empty without a target."""
        state, settings = self.state, self.settings
        if self.settings.hold is None or state.measured is None:
            return ""
        if state.lost_at is None and relative_error(self.settings.hold, state.measured) > MAX_FINAL_ERROR:
            return (
                f"hold={settings.hold:g} was not held at the end: guard {state.measured:.4g} at the last measurement, "
                f"when the weight of the regularisation was {state.factor:.3g} times the first one and still rising; "
                "measure more often (guard.every), raise the weight, or lower optimizer.lr"
            )
        if state.lost_at is None:
            return f"hold={settings.hold:g} was held: guard {state.measured:.4g} at the last measurement."
        return (
            f"hold={settings.hold:g} could not be held: at iteration {state.lost_at} the weight of the regularisation "
            f"was at its bound, {MAX_FACTOR:g} times the first one, and the held-out loss was still above the target "
            f"({state.measured:.4g} at the last measurement); lower optimizer.lr, raise the weight, or allow more"
        )

    def summary(self) -> dict[str, Any] | None:
        """Values for the metrics; None without a target."""
        if self.settings.hold is None:
            return None
        return {
            "target": self.settings.hold,
            "measured": self.state.measured,
            "weight": self.weight,
            "not_held_from": self.state.lost_at,
            "verdict": self.verdict(),
        }

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint."""
        return asdict(self.state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.state = HoldState(**state)


def add_regularisation_gradient(
    prior: ScenePrior,
    x0: Tensor,
    coefficient: float,
    generator: Generator,
    *,
    loss: SceneLoss | None = None,
    chunk: int | None = None,
    prompts: Sequence[str] | None = None,
) -> tuple[float, float]:
    """Add ``coefficient`` times the gradient of the mean (B,) ``loss`` of noised scenes (None: pretraining loss) to
    ``.grad``. ``x0`` (B, N, D) are normalised scenes of all processes, of which each takes its share; ``generator`` is
    on the CPU; a scene without a prompt has ``""``. Returns the mean loss of all scenes, and the norm of the scaled
    gradient.
    """
    if coefficient == 0:
        return 0.0, 0.0
    processes, parameters = ProcessGroup.current(), [p for p in prior.parameters() if p.requires_grad]
    before = [p.grad for p in parameters]
    for parameter in parameters:
        parameter.grad = None
    value, losses = 0.0, loss or prior.noised_loss
    noised, own = prior.noised(x0, generator), processes.rows(len(x0))
    for part in in_parts(parameters, own.stop - own.start, chunk):
        rows = slice(own.start + part.start, own.start + part.stop)
        with torch.no_grad():
            text = None if prompts is None else prior.encode_prompts(prompts[rows])
        mean = losses(noised.rows(rows), text).mean() * ((part.stop - part.start) / len(x0))
        value += float(mean.detach())
        if mean.requires_grad:  # not where all scenes are too noisy for a refinement that is trained alone
            (coefficient * mean).backward()
    processes.sum_gradients(parameters)
    norm = gradient_norm(parameters)
    for parameter, gradient in zip(parameters, before, strict=True):
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    return processes.sum_numbers(value)[0], norm


@dataclass(frozen=True)
class DiscriminativeLoss:
    """Direct discriminative optimisation (Zheng et al. 2025, arXiv 2503.01103) of a diffusion prior. The log-likelihood
    ratio of prior and base is the logit of a discriminator of real scenes and base samples; at its best, the prior has
    the density of real scenes. The pretraining loss l of a noised scene takes the place of -log p. With d = l(base) -
    l(prior), the losses are (2 / s) softplus(-s d) of real scenes and (2 / s) softplus(s d) of base samples. At the
    base prior, their gradients are those of l and of -l, which cancel in the mean where base samples are like real
    scenes. The gradient of a real scene vanishes where s d is large, that of a base sample where -s d is, so no sample
    repels without bound.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)))
    >>> loss = DiscriminativeLoss(prior, prior, sharpness=20.0)
    >>> [round(value, 4) for value in loss.of_base(noised).tolist()]  # (2 / s) log 2
    [0.0693, 0.0693]
    """

    prior: ScenePrior
    base: ScenePrior  # its weights get no gradient
    sharpness: float  # s, per unit of the pretraining loss; near 0 the loss of base samples has no bound

    def of_real(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) losses of noised real scenes."""
        return F.softplus(-self.sharpness * self.gap(noised, text)) * (2 / self.sharpness)

    def of_base(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) losses of noised samples of the base prior."""
        return F.softplus(self.sharpness * self.gap(noised, text)) * (2 / self.sharpness)

    def gap(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) pretraining losses of the base prior minus those of the prior in training."""
        with torch.no_grad():
            base = self.base.noised_loss(noised, text)
        return base - self.prior.noised_loss(noised, text)


def relative_error(target: float, measured: float) -> float:
    """Measured ratio minus target, divided by target minus 1: 0 at the target, -1 at the base prior's ratio."""
    error = (measured - 1.0) / (target - 1.0) - 1.0
    return max(-1.0, min(error, MAX_ERROR)) if error == error else MAX_ERROR


@dataclass(frozen=True)
class HoldState:
    """State of the controller; plain numbers, for checkpoints."""

    log_factor: float = 0.0  # of the factor on the weight of the regularisation
    iteration: int = 0  # of the last measurement
    measured: float | None = None  # last measured ratio
    slope: float = 0.0  # change of the ratio per iteration, averaged
    beyond: int = 0  # measurements in a row above the target with the factor at its upper bound
    lost_at: int | None = None  # iteration from which the target counts as not held; None while it counts as held

    @property
    def factor(self) -> float:
        """Factor on the weight."""
        return math.exp(self.log_factor)


def adjust(state: HoldState, target: float, measured: float, iteration: int) -> HoldState:
    """The state after the held-out loss was ``measured`` as a ratio to the base prior's, of which ``target`` is held:
    integral control of the factor's logarithm, within bounds (Ziegler et al. 2019, Eq. 4). Unlike there, the gain is
    per iteration, so that checks may come at any distance, and the ratio is extrapolated by ``LOOK_AHEAD`` iterations
    with its averaged change. The error is bounded; one that is not a number counts as the largest.

    >>> state = adjust(HoldState(), 1.05, measured=1.1, iteration=1)
    >>> round(state.factor, 3)
    1.162
    """
    span = max(1, iteration - state.iteration)
    first = measured if state.iteration else 1.0
    before = first if state.measured is None else state.measured
    slope = state.slope + (1.0 - math.exp(-span / SMOOTHING)) * ((measured - before) / span - state.slope)
    slope = slope if math.isfinite(slope) else 0.0
    error = relative_error(target, measured + LOOK_AHEAD * slope)
    step = GAIN * span * error
    log_factor = max(math.log(MIN_FACTOR), min(state.log_factor + step, math.log(MAX_FACTOR)))
    beyond = state.beyond + 1 if relative_error(target, measured) > 0 and log_factor >= math.log(MAX_FACTOR) else 0
    lost_at = iteration if state.lost_at is None and beyond >= PATIENCE else state.lost_at
    return HoldState(log_factor, iteration, measured, slope, beyond, lost_at)
