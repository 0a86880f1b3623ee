"""Count conditioning: numbers of objects that a prompt still asks for, added to the logits of the categories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.count_embedding import count_states
from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene

_DELTA = 0.02
"""Number of objects that is added before a logarithm is taken, so that it is finite."""
_KNOWN = 0.8
"""A text gives the number of a kind if the likeliest number has at least this probability."""
_LEAST = 0.1
"""Probability of the visible number and all larger ones; below it, fewer objects of a known number are expected."""
_TINY = 1e-9


@dataclass(frozen=True)
class CountConditioningConfig(ModuleConfig):
    """Numbers that a prompt asks for; the first text tokens are of the kinds of objects, and of all objects.

    Attributes:
        largest: the largest number that is told apart.
        kinds: (K - 1,) the kind of each category, as prompts call it; empty where each is one of its own.
    """

    largest: int
    kinds: tuple[int, ...] = ()

    name = "count_conditioning"
    place = "condition"
    reads_text = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "kinds", tuple(self.kinds))  # a list, when it comes from JSON

    def kinds_of(self, core: FluxSizes) -> tuple[int, ...]:
        """The kind of each category."""
        return self.kinds or tuple(range(core.categories - 1))

    def text_tokens(self, core: FluxSizes) -> int:
        return max(self.kinds_of(core)) + 2

    def build(self, core: FluxSizes) -> CountConditioning:
        return CountConditioning(self.kinds_of(core), core.text_width, core.hidden, self.largest)


class CountConditioning(FluxModule):
    """Logits (B, K) that are added to those of every slot: how much of each category is still wanted.

    A prompt asks for numbers: of objects, of cups, of whatever is named. Attention takes averages and learns exact
    numbers very slowly, so this module subtracts. The text gives the probability of each number of each kind of object
    (:meth:`count_logits`, trained on the counts of scenes). Numbers below the visible count are impossible. The mean
    of the other numbers minus the visible count is the number still missing. The missing objects of a kind over the
    number of masked slots estimate the probability that a masked slot is of that kind. The logits start from the
    logarithm of this probability, and a small network, the same for all kinds, corrects them. Sums are over slots, so
    that the network stays permutation-equivariant.

    Args:
        kinds: (C,) the kind 0..G-1 of each category but *empty*: prompts call several assets by one name.
        text_width: W, width of the text tokens: one for each kind, and a last one for all objects.
        hidden: width inside.
        most: largest number that is told apart; larger numbers count as this one.

    Attributes:
        things: G + 1, the number of kinds, plus one for all objects.

    >>> count_conditioning = CountConditioning(kinds=(0, 1, 1, 2), text_width=16, hidden=32, most=5)
    >>> count_conditioning(torch.randint(6, (2, 5)), torch.randn(2, 4, 16)).shape
    torch.Size([2, 5])
    """

    def __init__(self, kinds: Sequence[int], text_width: int, hidden: int, most: int) -> None:
        super().__init__()
        self.categories, self.things, self.most = len(kinds) + 1, max(kinds) + 2, most
        self.kinds: Tensor
        self.register_buffer("kinds", torch.tensor([*kinds, self.things - 1]), persistent=False)
        self.thing = nn.Parameter(0.02 * torch.randn(self.things, hidden))
        self.counts_out = nn.Sequential(nn.Linear(text_width, hidden), nn.SiLU(), nn.Linear(hidden, most + 1))
        self.asked_in = nn.Linear(text_width, hidden)
        self.seen_in = nn.Linear(8, hidden)
        self.inner = nn.Linear(hidden, hidden)
        self.out = nn.Linear(hidden, 1)
        self.trust = nn.Parameter(torch.ones(()))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def count_logits(self, tokens: Tensor) -> Tensor:
        """(B, G + 1, most + 1) logits of the numbers of each kind and of all objects, from ``tokens`` (B, G + 1, W)."""
        return self.counts_out(tokens)

    def count_loss(self, tokens: Tensor, states: Tensor) -> Tensor:
        """(B,) mean over kinds and objects of the cross-entropy of their numbers in scenes (B, N) of 0..K-1."""
        numbers = self._numbers(count_states(states, self.categories)).long().clamp(max=self.most)
        return F.cross_entropy(self.count_logits(tokens).transpose(1, 2), numbers, reduction="none").mean(dim=1)

    def logits(self, scene: Scene) -> Tensor | None:
        tokens = scene.own_text.get(CountConditioningConfig.name)
        if tokens is None:
            return None
        return self(scene.states, tokens, scene.slot_mask)[:, None]

    def forward(self, states: Tensor, tokens: Tensor, slot_mask: Tensor | None = None) -> Tensor:
        """Logits (B, K).

        Args:
            states: (B, N) int64 in 0..K, K being the mask token.
            tokens: (B, G + 1, W) leading tokens of the text encoder, one for each kind and the last for all objects.
            slot_mask: (B, N) bool, False for padding slots; None where there are none.
        """
        counts = count_states(states, self.categories, slot_mask).to(tokens.dtype)
        visible, masked = self._numbers(counts), counts[:, -1:]  # (B, G + 1), (B, 1)
        wanted = still_to_come(self.count_logits(tokens).detach(), visible)
        wanted = torch.cat([wanted[:, :-1], masked - wanted[:, -1:]], dim=1).clamp(min=0.0)  # last, empty slots
        share = torch.log((wanted + _DELTA) / (masked + 1.0))
        around = torch.cat([masked, visible[:, -1:]], dim=1)[:, None].expand(-1, self.things, -1)
        facts = torch.cat([torch.stack([visible, wanted], dim=-1), around], dim=-1)  # (B, G + 1, 4)
        inside = self.thing + self.asked_in(tokens) + self.seen_in(torch.cat([facts / 8.0, facts.log1p()], dim=-1))
        correction: Tensor = self.out(F.silu(self.inner(F.silu(inside))))
        return (self.trust * share + correction[..., 0])[:, self.kinds]

    def groups_by_number(self, tokens: Tensor) -> Tensor:
        """(B, K) int64: a group of its own for each kind whose number the text gives; all others are one group.

        *Empty* has a group of its own where the text gives the number of all objects. ``tokens`` as in :meth:`forward`.
        """
        known = self.count_logits(tokens).softmax(dim=-1).amax(dim=-1) >= _KNOWN
        return torch.where(known[:, self.kinds], self.kinds, self.things)

    def _numbers(self, counts: Tensor) -> Tensor:
        """(B, G + 1) objects of each kind, and in all, from (B, K) slots in each category; the last is not read."""
        objects = counts[:, :-1]
        kinds = objects.new_zeros(len(counts), self.things - 1).index_add_(1, self.kinds[:-1], objects)
        return torch.cat([kinds, objects.sum(dim=1, keepdim=True)], dim=1)


def still_to_come(logits: Tensor, visible: Tensor) -> Tensor:
    """Expected number of objects still missing, at least 0: (..., M) logits of 0..M-1 and (...) visible to (...).

    It is the mean of the numbers that are not below the visible one, minus the visible one. In one case it shrinks to 0
    in proportion: one number above 0 has a probability of at least ``_KNOWN``, and the numbers that are not below the
    visible one have less than ``_LEAST`` together. Then more objects are visible than the text asks for. Without this
    bound the mean would be that of the remote tail, and all masked slots would become objects of a kind that is
    complete. Kinds that are seldom present at all are not bounded in this way.

    >>> still_to_come(torch.tensor([[0.0, 0.0, 0.0, 0.0]]), torch.tensor([1.0]))  # 1, 2 or 3, as likely
    tensor([1.])
    >>> two = torch.tensor([-9.0, -9.0, 9.0, *[-9.0] * 60])  # the text asks for two, and three are visible
    >>> float(still_to_come(two, torch.tensor(3.0))) < 0.01
    True
    """
    number = torch.arange(logits.shape[-1], device=logits.device, dtype=logits.dtype)
    beyond = number - visible[..., None]
    probability = logits.softmax(dim=-1)
    weight = probability * (beyond >= 0)
    least = torch.where(probability[..., 1:].amax(dim=-1) >= _KNOWN, _LEAST, _TINY)
    return (weight * beyond).sum(dim=-1) / weight.sum(dim=-1).maximum(least)
