"""DDPO on a denoising policy: advantages, loss and gradient of a batch."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Generator, Tensor

from agents.post_training.advantages import Advantage
from agents.post_training.algorithm_settings import DDPOISSettings, DDPOSFSettings
from agents.post_training.base import Algorithm
from agents.post_training.gradients import BatchGradient, accumulate_policy_gradient, draw_steps
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.policy import DenoisingPolicy, gradient_weights


class DDPO(Algorithm):
    """DDPO-SF, or DDPO-IS if given the settings of DDPO-IS (Black et al. 2024).

    Args:
        settings: settings of the algorithm.
        policy: policy that is optimised.
        stds: (S,) smallest sigma of every step, normalised units.

    Attributes:
        loss: loss of a batch of transitions; its ``step_weights`` (S,) say which steps enter the gradient.
    """

    loss: DDPOSFLoss

    def __init__(self, settings: DDPOSFSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        self.settings, self.policy = settings, policy
        self.advantage = Advantage(credit=settings.credit)
        weights = gradient_weights(stds, min_std=settings.min_std)
        clip = settings.clip_epsilon if isinstance(settings, DDPOISSettings) else None
        self.loss = DDPOSFLoss(policy, step_weights=weights, reduction="mean", clip_epsilon=clip).to(
            next(policy.parameters()).device
        )

    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """Add the policy gradient of a batch to ``.grad``; ``generator`` draws the steps that enter it."""
        steps, scale = draw_steps(self.loss.step_weights.cpu(), self.settings.gradient_steps, generator)
        return accumulate_policy_gradient(self.loss, batch, steps, scale=scale)
