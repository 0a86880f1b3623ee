"""What a prompt asks of each category, beside how much of it is there already."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.tally import count_states


class Requests(nn.Module):
    """Logits (B, K) that are added to those of every slot: how much each category is still wanted.

    A prompt asks for numbers: of objects, of cups, of whatever is named. While slots are masked, what remains to be
    placed is the difference between that number and what is seen. One small network, the same for all categories,
    learns to take it; left to attention, prompts of exact numbers are learned very slowly. The sums are over slots, so
    that the network stays permutation-equivariant.

    Args:
        categories: K = C + 1, *empty* last; what it is told of *empty* is how full the scene is as a whole.
        text_width: W, of what the text encoder says of each category.
        hidden: width inside.

    >>> requests = Requests(categories=8, text_width=16, hidden=32)
    >>> requests(torch.randint(9, (2, 5)), torch.randn(2, 8, 16)).shape
    torch.Size([2, 8])
    """

    def __init__(self, categories: int, text_width: int, hidden: int) -> None:
        super().__init__()
        self.categories = categories
        self.category = nn.Parameter(0.02 * torch.randn(categories, hidden))
        self.asked_in = nn.Linear(text_width, hidden)
        self.seen_in = nn.Linear(6, hidden)
        self.inner = nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, states: Tensor, asked: Tensor | None = None, slot_mask: Tensor | None = None) -> Tensor:
        """Logits (B, K).

        Args:
            states: (B, N) int64 in 0..K, K being the mask token.
            asked: (B, K, W) what the text encoder says of each category; None for no text.
            slot_mask: (B, N) bool, False for filling; None where there is none.
        """
        counts = count_states(states, self.categories, slot_mask).to(self.category.dtype)  # (B, K), masked ones last
        masked, objects = counts[:, -1:], counts[:, :-1].sum(dim=1, keepdim=True)
        seen = torch.stack([F.pad(counts[:, :-1], (0, 1)), objects.expand_as(counts), masked.expand_as(counts)], dim=-1)
        inside = self.category + self.seen_in(torch.cat([seen / 8.0, seen.log1p()], dim=-1))  # (B, K, H)
        if asked is not None:
            inside = inside + self.asked_in(asked)
        wanted: Tensor = self.out(F.silu(self.inner(F.silu(inside))))
        return wanted[..., 0]
