"""Adaptive control of the regularisation: a target, and the factor on the weights that holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scene_envs.errors import InvalidInputError, unknown_name

BASE_VALUES = {"guard": 1.0, "kl": 0.0}
"""Figures that can be held, and their values for the base prior."""
LOWEST, HIGHEST = 0.01, 100.0
"""Bounds of the factor."""
GAIN = 0.05
"""Change of the factor's logarithm per iteration, for a figure whose excess is twice that of the target."""
LOOK_AHEAD = 30.0
"""Iterations ahead for which a measurement is extrapolated: weights act with a delay."""
SMOOTHING = 10.0
"""Iterations over which the figure's change per iteration is averaged."""
LARGEST_ERROR = 3.0
FAR = 0.5
"""Error of the last measurement from which a target counts as not held at the end."""
PATIENCE = 3
"""Measurements in a row above the target, with the factor at its bound, after which it counts as not held."""


@dataclass(frozen=True)
class Target:
    """A figure and the value at which it is held.

    Attributes:
        figure: ``guard``, the held-out loss as a ratio to the base prior's, or ``kl``, the KL divergence from the base
            prior in nats per random variable.
        value: above that of the base prior.
    """

    figure: str
    value: float

    @classmethod
    def parse(cls, text: str) -> Target:
        """From ``FIGURE:VALUE``.

        Raises:
            UnknownNameError: no such figure.
            InvalidInputError: the value is no number, or not above that of the base prior.

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
        """Distance beyond the target, divided by that of the target from the base value: -1 at the base value."""
        base = BASE_VALUES[self.figure]
        error = (measured - base) / (self.value - base) - 1.0
        return max(-1.0, min(error, LARGEST_ERROR)) if error == error else LARGEST_ERROR


@dataclass(frozen=True)
class HoldState:
    """State of the controller; plain numbers, for checkpoints.

    Attributes:
        log_factor: logarithm of the factor on the weights of the regularisation.
        iteration: of the last measurement.
        measured: the last value; None before the first.
        slope: its change per iteration, averaged.
        beyond: measurements in a row that were above the target while the factor was at its upper bound.
        lost_at: iteration from which the target counts as not held; None where it does not.
    """

    log_factor: float = 0.0
    iteration: int = 0
    measured: float | None = None
    slope: float = 0.0
    beyond: int = 0
    lost_at: int | None = None

    @property
    def factor(self) -> float:
        """On the weights."""
        return math.exp(self.log_factor)


def adjust(state: HoldState, target: Target, measured: float, iteration: int) -> HoldState:
    """The state after a measurement: integral control of the factor's logarithm, within bounds.

    The KL controller of Ziegler et al. (2019, Eq. 4) with a gain per iteration, so that checks may come at any
    distance, on the figure as it will be in ``LOOK_AHEAD`` iterations if it changes as before. The error is bounded;
    one that is not a number counts as the largest.

    Args:
        state: before.
        target: what is held.
        measured: the figure now.
        iteration: that is finished.

    >>> state = adjust(HoldState(), Target("kl", 0.01), measured=0.02, iteration=1)
    >>> round(state.factor, 3)
    1.162
    """
    span = max(1, iteration - state.iteration)
    before = BASE_VALUES[target.figure] if state.measured is None else state.measured
    slope = state.slope + (1.0 - math.exp(-span / SMOOTHING)) * ((measured - before) / span - state.slope)
    slope = slope if math.isfinite(slope) else 0.0
    error = target.error(measured + LOOK_AHEAD * slope)
    step = GAIN * span * error
    log_factor = max(math.log(LOWEST), min(state.log_factor + step, math.log(HIGHEST)))
    beyond = state.beyond + 1 if target.error(measured) > 0 and log_factor >= math.log(HIGHEST) else 0
    lost_at = iteration if state.lost_at is None and beyond >= PATIENCE else state.lost_at
    return HoldState(log_factor, iteration, measured, slope, beyond, lost_at)
