"""Deep Sets denoiser (Zaheer et al. 2017) of mixed scenes: every slot sees itself and the mean of all slots."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from agents.networks import register_network


@dataclass(frozen=True)
class DeepSetsConfig:
    """Size of a :class:`DeepSets`; ``hidden`` and ``depth`` are the keys of a training run."""

    categories: int
    hidden: int = 64
    depth: int = 2


class DeepSets(nn.Module):
    """Poses (B, N, 12), states (B, N) and time (B,) to a pose output (B, N, 12) and logits (B, N, K)."""

    def __init__(self, config: DeepSetsConfig) -> None:
        super().__init__()
        self.config = config
        self.states = nn.Embedding(config.categories + 1, config.hidden)
        self.read = nn.Linear(12 + 1, config.hidden)
        self.layers = nn.ModuleList(nn.Linear(2 * config.hidden, config.hidden) for _ in range(config.depth))
        self.out = nn.Linear(config.hidden, 12 + config.categories)

    def forward(self, pose: Tensor, states: Tensor, time: Tensor, **_: Any) -> tuple[Tensor, Tensor]:
        """Predict; what else a denoiser is told (positions, text, observed entries) is not read here."""
        when = (time / 1000.0)[:, None, None].expand(-1, pose.shape[1], 1)
        slots = self.read(torch.cat([pose, when], dim=-1)) + self.states(states)
        for layer in self.layers:
            around = slots.mean(dim=1, keepdim=True).expand_as(slots)
            slots = slots + torch.relu(layer(torch.cat([slots, around], dim=-1)))
        output, logits = self.out(slots).split([12, self.config.categories], dim=-1)
        return output, logits


register_network("deep_sets", "mixed", DeepSetsConfig, DeepSets)
