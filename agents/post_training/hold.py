"""Adaptive control of the regularisation: a target, and the factor on the weights that holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from scene_envs.errors import InvalidInputError, unknown_name

BASE_VALUES = {"guard": 1.0, "kl": 0.0}
"""Figures that can be held, and their values for the base prior."""
LOWEST, HIGHEST = 0.01, 100.0
"""Bounds of the factor."""
GAIN = 0.05
"""Change of the factor's logarithm per iteration if the figure's excess over its base value is twice the target's."""
LOOK_AHEAD = 30.0
"""Iterations by which a measurement is extrapolated, because the weights act with a delay."""
SMOOTHING = 10.0
"""Iterations over which the figure's change per iteration is averaged."""
LARGEST_ERROR = 3.0
FAR = 0.5
"""A target counts as not held at the end if the error of the last measurement is larger than this."""
PATIENCE = 3
"""Measurements in a row above the target, with the factor at its upper bound, after which the target is not held."""


@dataclass(frozen=True)
class Target:
    """A figure and the value at which it is held.

    Attributes:
        figure: ``guard``, the held-out loss as a ratio to the base prior's, or ``kl``, the KL divergence from the base
            prior in nats per random variable.
        value: value to hold, above that of the base prior.
    """

    figure: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Target:
        """The target that a text ``FIGURE:VALUE`` describes.

        Raises:
            UnknownNameError: no such figure.
            InvalidInputError: the value is not a number, or not above that of the base prior.

        >>> Target.parse("guard:1.05")
        Target(figure='guard', value=1.05)
        """
        figure, _, number = text.partition(":")
        if figure not in BASE_VALUES:
            raise unknown_name("figure to hold", figure, BASE_VALUES)
        base = BASE_VALUES[figure]
        try:
            value = float(number)
        except ValueError:
            raise InvalidInputError(
                f"hold={text!r}: {number!r} is not a number; write {figure}:{base + 0.05:g}"
            ) from None
        if not base < value < math.inf:
            raise InvalidInputError(
                f"hold={text!r}: the {figure} of the base prior is {base:g}, and a run loses from there; give a finite "
                f"value above it, such as {figure}:{base + 0.05:g}"
            )
        return cls(figure, value)

    def error(self, measured: float) -> float:
        """Measured value minus target, divided by target minus base value: 0 at the target, -1 at the base value."""
        base = BASE_VALUES[self.figure]
        error = (measured - base) / (self.value - base) - 1.0
        return max(-1.0, min(error, LARGEST_ERROR)) if error == error else LARGEST_ERROR


@dataclass(frozen=True)
class HoldState:
    """State of the controller; plain numbers, for checkpoints.

    Attributes:
        log_factor: logarithm of the factor on the weights of the regularisation.
        iteration: of the last measurement.
        measured: the last value; None before the first, and after a return to a checkpoint whose value is not known.
        slope: its change per iteration, averaged.
        beyond: measurements in a row that were above the target while the factor was at its upper bound.
        lost_at: iteration from which the target counts as not held; None while it counts as held.
    """

    log_factor: float = 0.0
    iteration: int = 0
    measured: float | None = None
    slope: float = 0.0
    beyond: int = 0
    lost_at: int | None = None

    @property
    def factor(self) -> float:
        """Factor on the weights."""
        return math.exp(self.log_factor)

    def returned(self, measured: float | None) -> HoldState:
        """The state after a return to an earlier checkpoint, which is no change of the figure by training.

        Args:
            measured: the figure of this checkpoint; None if it is not known.
        """
        return replace(self, measured=measured, slope=0.0)


def adjust(state: HoldState, target: Target, measured: float, iteration: int) -> HoldState:
    """The state after a measurement: integral control of the factor's logarithm, within bounds.

    It is the KL controller of Ziegler et al. (2019, Eq. 4) with two changes. The gain is per iteration, so that checks
    may come at any distance. The figure is extrapolated by ``LOOK_AHEAD`` iterations with its averaged change per
    iteration. The error is bounded; an error that is not a number counts as the largest.

    Args:
        state: state before the measurement.
        target: target that is held.
        measured: the figure now.
        iteration: number of the finished iteration.

    >>> state = adjust(HoldState(), Target("kl", 0.01), measured=0.02, iteration=1)
    >>> round(state.factor, 3)
    1.162
    """
    span = max(1, iteration - state.iteration)
    first = measured if state.iteration else BASE_VALUES[target.figure]
    before = first if state.measured is None else state.measured
    slope = state.slope + (1.0 - math.exp(-span / SMOOTHING)) * ((measured - before) / span - state.slope)
    slope = slope if math.isfinite(slope) else 0.0
    error = target.error(measured + LOOK_AHEAD * slope)
    step = GAIN * span * error
    log_factor = max(math.log(LOWEST), min(state.log_factor + step, math.log(HIGHEST)))
    beyond = state.beyond + 1 if target.error(measured) > 0 and log_factor >= math.log(HIGHEST) else 0
    lost_at = iteration if state.lost_at is None and beyond >= PATIENCE else state.lost_at
    return HoldState(log_factor, iteration, measured, slope, beyond, lost_at)
