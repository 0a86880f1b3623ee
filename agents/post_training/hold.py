"""Adaptive control of the regularisation: the factor on its weight that holds the held-out loss at a target."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from scene_envs.errors import InvalidInputError

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


def held_ratio(text: str) -> float:
    """Ratio of the held-out loss to the base prior's that a text ``guard:RATIO`` names.

    Raises:
        InvalidInputError: the text has another form, or the ratio is not above 1.

    >>> held_ratio("guard:1.05")
    1.05
    """
    figure, _, number = text.partition(":")
    try:
        ratio = float(number) if figure == "guard" else math.nan
    except ValueError:
        ratio = math.nan
    if not 1 < ratio < math.inf:
        raise InvalidInputError(
            f"hold={text!r} must be guard:RATIO, a finite ratio of held-out losses above 1, the base prior's, such as "
            "guard:1.05"
        )
    return ratio


def relative_error(target: float, measured: float) -> float:
    """Measured ratio minus target, divided by target minus 1: 0 at the target, -1 at the base prior's ratio."""
    error = (measured - 1.0) / (target - 1.0) - 1.0
    return max(-1.0, min(error, LARGEST_ERROR)) if error == error else LARGEST_ERROR


@dataclass(frozen=True)
class HoldState:
    """State of the controller; plain numbers, for checkpoints.

    Attributes:
        log_factor: logarithm of the factor on the weight of the regularisation.
        iteration: of the last measurement.
        measured: the last value; None before the first.
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
        """Factor on the weight."""
        return math.exp(self.log_factor)

    def returned(self, measured: float) -> HoldState:
        """The state after a return to an earlier checkpoint of ratio ``measured``, which is no change by training."""
        return replace(self, measured=measured, slope=0.0)


def adjust(state: HoldState, target: float, measured: float, iteration: int) -> HoldState:
    """The state after a measurement: integral control of the factor's logarithm, within bounds.

    It is the controller of Ziegler et al. (2019, Eq. 4) with two changes. The gain is per iteration, so that checks
    may come at any distance. The figure is extrapolated by ``LOOK_AHEAD`` iterations with its averaged change per
    iteration. The error is bounded; an error that is not a number counts as the largest.

    Args:
        state: state before the measurement.
        target: ratio that is held.
        measured: ratio of the held-out loss to the base prior's now.
        iteration: number of the finished iteration.

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
    log_factor = max(math.log(LOWEST), min(state.log_factor + step, math.log(HIGHEST)))
    beyond = state.beyond + 1 if relative_error(target, measured) > 0 and log_factor >= math.log(HIGHEST) else 0
    lost_at = iteration if state.lost_at is None and beyond >= PATIENCE else state.lost_at
    return HoldState(log_factor, iteration, measured, slope, beyond, lost_at)
