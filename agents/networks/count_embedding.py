"""Count embedding: numbers of visible slots of each category and of masked slots, added to the embedded time.

Attention computes averages, but a prompt asks for numbers of objects.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene


@dataclass(frozen=True)
class CountEmbeddingConfig(ModuleConfig):
    """Counts of visible slots, read together with the mean text token where there is text."""

    name = "count_embedding"
    place = "condition"

    def build(self, core: FluxSizes) -> CountEmbedding:
        return CountEmbedding(core.categories, core.text_width, core.hidden)


def count_states(states: Tensor, categories: int, slot_mask: Tensor | None = None) -> Tensor:
    """(B, K) numbers of slots in each category; in the place of *empty*, the number of masked slots.

    Empty slots are not counted, so that leaving them out of the network's batch changes nothing.

    Args:
        states: (B, N) int64 in 0..K, K being the mask token and K - 1 *empty*.
        categories: K.
        slot_mask: (B, N) bool, False for padding slots; None where there are none.

    >>> count_states(torch.tensor([[0, 0, 1, 2, 3, 3]]), 3).tolist()
    [[2.0, 1.0, 2.0]]
    """
    counted = F.one_hot(states, categories + 1).float()
    if slot_mask is not None:
        counted = counted * slot_mask[..., None]
    counts = counted.sum(dim=1)
    return torch.cat([counts[:, : categories - 1], counts[:, categories:]], dim=1)


class CountEmbedding(FluxModule):
    """Counts of visible slots and the mean text token, to one vector (B, H) that is added to the condition.

    Args:
        categories: K = C + 1.
        text_width: width of the text tokens; 0 for none.
        hidden: H.

    >>> count_embedding = CountEmbedding(categories=8, text_width=16, hidden=32)
    >>> count_embedding(torch.randint(9, (2, 5)), torch.randn(2, 16)).shape
    torch.Size([2, 32])
    """

    def __init__(self, categories: int, text_width: int, hidden: int) -> None:
        super().__init__()
        self.categories, self.text_width = categories, text_width
        self.layers = nn.Sequential(
            nn.Linear(2 * categories + text_width, 2 * hidden), nn.SiLU(), nn.Linear(2 * hidden, hidden)
        )

    def condition(self, scene: Scene) -> Tensor | None:
        return self(scene.states, scene.summary, scene.slot_mask)

    def forward(self, states: Tensor, text: Tensor | None = None, slot_mask: Tensor | None = None) -> Tensor:
        """Embed the numbers of :func:`count_states` with ``text`` (B, W), the mean text token; zeros when None."""
        counts = count_states(states, self.categories, slot_mask).to(next(self.parameters()).dtype)
        inputs = [counts / 8.0, counts.log1p()]
        if self.text_width:
            inputs.append(counts.new_zeros(len(counts), self.text_width) if text is None else text)
        return self.layers(torch.cat(inputs, dim=1))
