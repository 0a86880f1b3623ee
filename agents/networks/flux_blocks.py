"""The blocks of Flux-style transformers: single-stream, and double-stream with joint attention (Esser et al. 2024)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.relations import joint_attention


class SingleStreamBlock(nn.Module):
    """Attention and MLP in parallel on a modulated LayerNorm, gated (Flux; Dehghani et al. 2023).

    Args:
        hidden: width of the tokens.
        heads: attention heads.
        mlp_ratio: width of the MLP over ``hidden``.
        relations: features per pair of slots that attention sums with its weights; 0 for none.
    """

    def __init__(self, hidden: int, heads: int, mlp_ratio: float, relations: int = 0) -> None:
        super().__init__()
        self.heads = heads
        self.hidden = hidden
        self.mlp_hidden = int(hidden * mlp_ratio)
        self.modulation = nn.Linear(hidden, 3 * hidden)
        self.linear1 = nn.Linear(hidden, 3 * hidden + self.mlp_hidden)
        self.linear2 = nn.Linear(hidden + self.mlp_hidden, hidden)
        self.query_norm = nn.RMSNorm(hidden // heads, eps=1e-6)
        self.key_norm = nn.RMSNorm(hidden // heads, eps=1e-6)
        self.gathered = nn.Linear(heads * relations, hidden, bias=False) if relations else None
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(
        self, tokens: Tensor, condition: Tensor, mask: Tensor | None = None, relations: Tensor | None = None
    ) -> Tensor:
        """Tokens (B, T, H) and condition (B, H) to tokens (B, T, H).

        Args:
            tokens: (B, T, H).
            condition: (B, H).
            mask: (B, 1 or heads, 1 or T, T), bool, True where to attend, or float, added to the attention logits.
            relations: (B, N, N, F) features of pairs of the last N tokens; needs a float mask.
        """
        shift, scale, gate = self.modulation(F.silu(condition)).unsqueeze(1).chunk(3, dim=-1)
        x = (1 + scale) * F.layer_norm(tokens, (self.hidden,), eps=1e-6) + shift
        qkv, mlp = self.linear1(x).split([3 * self.hidden, self.mlp_hidden], dim=-1)
        query, key, value = qkv.unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = joint_attention(self.query_norm(query), self.key_norm(key), value, mask, relations, self.gathered)
        return tokens + gate * self.linear2(torch.cat([attended, F.gelu(mlp, approximate="tanh")], dim=-1))


class DoubleStreamBlock(nn.Module):
    """Joint attention of two streams with their own projections, norms and MLPs, gated by the condition.

    Args:
        hidden, heads, mlp_ratio, relations: as in :class:`SingleStreamBlock`.
        text_ends: whether no later block reads the text, so that this block need not update it.
    """

    def __init__(self, hidden: int, heads: int, mlp_ratio: float, relations: int = 0, text_ends: bool = False) -> None:
        super().__init__()
        self.text = _Stream(hidden, heads, mlp_ratio, finishes=not text_ends)
        self.scene = _Stream(hidden, heads, mlp_ratio)
        self.gathered = nn.Linear(heads * relations, hidden, bias=False) if relations else None

    def forward(
        self, scene: Tensor, text: Tensor, condition: Tensor, mask: Tensor | None, relations: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Slots (B, N, H) and text (B, L, H) to the same; ``mask`` and ``relations`` as in single-stream blocks."""
        scene, text = scene + self.scene.modality, text + self.text.modality
        rates = [stream.rates(condition) for stream in (self.text, self.scene)]
        parts = [s.heads_of(x, r) for s, x, r in zip((self.text, self.scene), (text, scene), rates, strict=True)]
        query, key, value = (torch.cat(pair, dim=2) for pair in zip(*parts, strict=True))
        attended = joint_attention(query, key, value, mask, relations, self.gathered)
        count = text.shape[1]
        return (
            self.scene.finish(scene, attended[:, count:], rates[1]),
            self.text.finish(text, attended[:, :count], rates[0]) if self.text.finishes else text,
        )


class _Stream(nn.Module):
    """One side of a double-stream block."""

    def __init__(self, hidden: int, heads: int, mlp_ratio: float, finishes: bool = True) -> None:
        super().__init__()
        self.hidden, self.heads, self.finishes = hidden, heads, finishes
        self.modality = nn.Parameter(torch.zeros(1, 1, hidden))
        self.modulation = nn.Linear(hidden, (6 if finishes else 2) * hidden)
        self.qkv = nn.Linear(hidden, 3 * hidden)
        self.query_norm = nn.RMSNorm(hidden // heads, eps=1e-6) if finishes else nn.Identity()
        self.key_norm = nn.RMSNorm(hidden // heads, eps=1e-6)
        if finishes:
            self.out = nn.Linear(hidden, hidden)
            wide = int(hidden * mlp_ratio)
            self.mlp = nn.Sequential(nn.Linear(hidden, wide), nn.GELU(approximate="tanh"), nn.Linear(wide, hidden))
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def rates(self, condition: Tensor) -> tuple[Tensor, ...]:
        """Shift, scale and gate of the attention, then of the MLP, (B, 1, H) each; the first two where text ends."""
        return self.modulation(F.silu(condition)).unsqueeze(1).chunk(6 if self.finishes else 2, dim=-1)  # type: ignore[no-any-return]

    def heads_of(self, x: Tensor, rates: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
        """Query, key and value (B, heads, N, width)."""
        x = (1 + rates[1]) * F.layer_norm(x, (self.hidden,), eps=1e-6) + rates[0]
        query, key, value = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.query_norm(query), self.key_norm(key), value

    def finish(self, x: Tensor, attended: Tensor, rates: tuple[Tensor, ...]) -> Tensor:
        """The tokens after the gated residuals of attention and MLP."""
        x = x + rates[2] * self.out(attended)
        inner = (1 + rates[4]) * F.layer_norm(x, (self.hidden,), eps=1e-6) + rates[3]
        return x + rates[5] * self.mlp(inner)
