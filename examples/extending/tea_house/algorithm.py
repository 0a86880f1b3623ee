"""An algorithm: the policy gradient with a quadratic penalty on the log-ratio in place of a clip."""

from dataclasses import dataclass

from tensordict import TensorDict
from torch import nn

from agents.post_training import DDPO, DDPOSFSettings, register_algorithm


@dataclass
class ProximalSettings(DDPOSFSettings):
    """DDPO with a proximal penalty.

    Attributes:
        penalty: coefficient of the squared log-ratio between the policy and the one that sampled.
        updates: optimiser steps per batch.
    """

    name: str = "proximal"
    penalty: float = 1.0
    updates: int = 2

    @property
    def optimiser_steps(self):
        return self.updates


class ProximalLoss(nn.Module):
    """- mean over valid scenes of weight(t) * (ratio * A - penalty * log(ratio)^2)."""

    def __init__(self, policy, step_weights, penalty):
        super().__init__()
        self.policy, self.penalty = policy, penalty
        self.register_buffer("step_weights", step_weights)

    def forward(self, transitions):
        """The loss of scenes that are all at the same step of the chain."""
        step = self.policy.step_of(int(transitions["timestep"].flatten()[0]))
        text = None if transitions.get("text", None) is None else (transitions["text"], transitions["text_mask"])
        log_prob = self.policy.log_prob(transitions["scene"], step, transitions["action"], text)
        entries = self.policy.random_entries(log_prob.shape[1])
        log_ratio = (log_prob - transitions["slot_log_prob"]) / entries  # (B, N)
        advantage = transitions["advantage"].reshape(len(log_ratio), -1)  # (B, 1), or (B, N) for credit per slot
        if advantage.shape[1] == 1:
            log_ratio = log_ratio.sum(dim=1, keepdim=True)
        objective = (log_ratio.exp() * advantage - self.penalty * log_ratio**2).sum(dim=1)
        valid = transitions["valid"].reshape(-1)
        loss = -self.step_weights[step] * objective[valid].sum() / valid.sum().clamp(min=1)
        largest = (entries * log_ratio.detach()).sum(dim=1).abs().max()
        return TensorDict({"loss_objective": loss, "log_ratio": largest, "clip_fraction": loss.detach() * 0})


@register_algorithm("proximal", ProximalSettings)
class Proximal(DDPO):
    """DDPO whose loss is :class:`ProximalLoss`."""

    def __init__(self, settings, policy, stds):
        super().__init__(settings, policy, stds)
        self.loss = ProximalLoss(policy, self.loss.step_weights, settings.penalty)
