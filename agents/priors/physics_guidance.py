"""Physics guidance: denoising whose poses are moved out of overlaps, and down onto what is below them."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from scene_envs.physics.correction import corrections
from scene_envs.scene import SceneBatch

_FINE = 0.03
"""Error (m) of horizontal positions below which objects are moved; above it, overlaps are not known yet."""


class PhysicsGuidance:
    """Moves the objects of each scene out of overlaps and onto supports, at the last steps of the denoising.

    From the step on at which the horizontal error of the denoised positions is below 3 cm, objects that overlap in the
    denoised scene come apart, and floating ones come down, by ``strength`` times the moves of
    :func:`~scene_envs.physics.correction.corrections`. The following steps adapt the scene to the moves. At the last
    step the moves change the sample itself.

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
        self._movable = None if movable is None else movable.cpu().numpy()

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor | None:
        """(B, N, 3) m, how far the denoised positions move; None at steps at which nothing moves.

        Args:
            step, steps: not used.
            denoised: gives the B scenes that the network expects.
            std: (3,) standard deviation of their positions along the axes of the world, m.
        """
        if not self.acts(std):
            return None
        error = std.cpu().double().numpy()
        return (self.strength * corrections(denoised().to("cpu"), error, self._movable)).to(std.device)

    @staticmethod
    def acts(std: Tensor) -> bool:
        """Whether objects are moved at steps whose denoised positions have the standard deviation ``std`` (3,), m."""
        return float(std[:2].max()) <= _FINE
