"""A small set transformer over the objects of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.evaluation.scene_tokens import NEIGHBOUR_FEATURES
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True)
class SetNetworkConfig:
    """Size of a :class:`SetNetwork`.

    Attributes:
        features: number of features of an object.
        categories: number of category tokens, those for *empty* and *unknown* included.
        outputs: number of outputs for a scene.
        hidden: width of the tokens; a multiple of ``heads``.
        heads: number of attention heads.
        blocks: number of induced attention blocks.
        inducing: number of inducing points per block.
        dropout: share of the pooled features dropped in training.
        pair_features: number of features of each neighbour of an object.
    """

    features: int
    categories: int
    outputs: int
    hidden: int = 32
    heads: int = 2
    blocks: int = 1
    inducing: int = 8
    dropout: float = 0.1
    pair_features: int = NEIGHBOUR_FEATURES

    def __post_init__(self) -> None:
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")


class _Attention(nn.Module):
    """Multi-head attention of queries to keys, with a residual and an MLP (MAB of Lee et al. 2019, pre-norm)."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query_norm, self.key_norm, self.mlp_norm = (nn.LayerNorm(hidden) for _ in range(3))
        self.query = nn.Linear(hidden, hidden)
        self.key_value = nn.Linear(hidden, 2 * hidden)
        self.out = nn.Linear(hidden, hidden)
        self.mlp = nn.Sequential(nn.Linear(hidden, 2 * hidden), nn.GELU(), nn.Linear(2 * hidden, hidden))

    def forward(self, queries: Tensor, keys: Tensor, mask: Tensor | None = None) -> Tensor:
        """Queries (B, M, H) and keys (B, N, H) to (B, M, H); ``mask`` (B, 1, 1, N) is True where to attend."""
        query = self.query(self.query_norm(queries)).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = self.key_value(self.key_norm(keys)).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=mask).transpose(1, 2).flatten(-2)
        queries = queries + self.out(attended)
        return queries + self.mlp(self.mlp_norm(queries))


class _InducedBlock(nn.Module):
    """Self-attention through a few learned points, linear in the number of objects (ISAB of Lee et al. 2019)."""

    def __init__(self, config: SetNetworkConfig) -> None:
        super().__init__()
        self.points = nn.Parameter(0.5 * torch.randn(1, config.inducing, config.hidden))
        self.gather = _Attention(config.hidden, config.heads)
        self.spread = _Attention(config.hidden, config.heads)

    def forward(self, tokens: Tensor, mask: Tensor) -> Tensor:
        """Tokens (B, N, H) to tokens of the same shape."""
        summary = self.gather(self.points.expand(tokens.shape[0], -1, -1), tokens, mask)
        return self.spread(tokens, summary)


class _ObjectEncoder(nn.Module):
    """Encoder of the objects of a scene: one token each, which depends on the other objects and not on padding.

    A Set Transformer (Lee et al. 2019) with induced attention. Before the attention, a small MLP over pairs reads the
    nearest neighbours of each object; overlaps and distances enter there.
    """

    def __init__(self, config: SetNetworkConfig) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden
        self.own = nn.Linear(config.features, hidden)
        self.category = nn.Embedding(config.categories, hidden)
        self.pair = nn.Linear(config.pair_features, hidden)
        self.pair_self = nn.Embedding(config.categories, hidden)
        self.pair_other = nn.Embedding(config.categories, hidden)
        self.enter = nn.Sequential(nn.Linear(3 * hidden, 2 * hidden), nn.GELU(), nn.Linear(2 * hidden, hidden))
        self.blocks = nn.ModuleList(_InducedBlock(config) for _ in range(config.blocks))

    def _reset_embeddings(self) -> None:
        for embedding in (self.category, self.pair_self, self.pair_other):
            nn.init.normal_(embedding.weight, std=0.3)

    def encode(
        self, own: Tensor, categories: Tensor, offsets: Tensor, neighbours: Tensor, present: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Tokens (B, N, H), 0 for padding, and the mask (B, 1, 1, N) of attention to them; arguments as in forward."""
        there = present[..., None].to(own.dtype)
        pairs = self.pair(offsets) + self.pair_other(neighbours) + self.pair_self(categories)[:, :, None]
        pairs = F.gelu(pairs)
        around = torch.cat([pairs.mean(dim=2), pairs.amax(dim=2)], dim=-1)
        tokens = self.enter(torch.cat([F.gelu(self.own(own) + self.category(categories)), around], dim=-1))
        somewhere = present.any(dim=-1, keepdim=True)
        mask = (present | ~somewhere)[:, None, None]  # a scene without objects attends to padding, which is zero
        tokens = tokens * there
        for block in self.blocks:
            tokens = block(tokens, mask) * there
        return tokens, mask


class ObjectNetwork(_ObjectEncoder):
    """Network with one logit for each object of a scene, from its neighbours, and from all objects if ``blocks`` > 0.

    ``outputs`` and ``dropout`` of the config are not read.

    >>> network = ObjectNetwork(SetNetworkConfig(features=5, categories=4, outputs=1))
    >>> objects = torch.randn(2, 6, 5), torch.randint(4, (2, 6)), torch.randn(2, 6, 3, 7), torch.randint(4, (2, 6, 3))
    >>> network(*objects, torch.ones(2, 6, dtype=torch.bool)).shape
    torch.Size([2, 6])
    """

    def __init__(self, config: SetNetworkConfig) -> None:
        super().__init__(config)
        self.leave = nn.Sequential(nn.LayerNorm(config.hidden), nn.Linear(config.hidden, 1))
        self._reset_embeddings()

    def forward(self, own: Tensor, categories: Tensor, offsets: Tensor, neighbours: Tensor, present: Tensor) -> Tensor:
        """(B, N) logits; arguments as for :class:`SetNetwork`."""
        tokens, _ = self.encode(own, categories, offsets, neighbours, present)
        logits: Tensor = self.leave(tokens)
        return logits[..., 0]


class SetNetwork(_ObjectEncoder):
    """Network with ``outputs`` numbers for a scene, invariant to the order of objects and to padding.

    The tokens of the objects are pooled by attention, mean, maximum and a scaled sum.

    >>> network = SetNetwork(SetNetworkConfig(features=5, categories=4, outputs=2)).eval()
    >>> objects = torch.randn(2, 6, 5), torch.randint(4, (2, 6)), torch.randn(2, 6, 3, 7), torch.randint(4, (2, 6, 3))
    >>> network(*objects, torch.ones(2, 6, dtype=torch.bool)).shape
    torch.Size([2, 2])
    """

    def __init__(self, config: SetNetworkConfig) -> None:
        super().__init__(config)
        hidden = config.hidden
        self.seed = nn.Parameter(0.5 * torch.randn(1, 1, hidden))
        self.pool = _Attention(hidden, config.heads)
        self.norm = nn.LayerNorm(4 * hidden)
        self.leave = nn.Sequential(
            nn.Dropout(config.dropout),
            nn.Linear(4 * hidden, 2 * hidden),
            nn.GELU(),
            nn.Linear(2 * hidden, config.outputs),
        )
        self._reset_embeddings()

    def forward(self, own: Tensor, categories: Tensor, offsets: Tensor, neighbours: Tensor, present: Tensor) -> Tensor:
        """Outputs per scene: logits, or features.

        Args:
            own: (B, N, F) features of each object.
            categories: (B, N) int64 categories of the objects.
            offsets: (B, N, K, P) features of each neighbour.
            neighbours: (B, N, K) int64 categories of the neighbours.
            present: (B, N) bool, False for padding.

        Returns:
            (B, ``outputs``).
        """
        tokens, mask = self.encode(own, categories, offsets, neighbours, present)
        somewhere = present.any(dim=-1, keepdim=True)
        there = present[..., None].to(own.dtype)
        pooled = self.pool(self.seed.expand(tokens.shape[0], -1, -1), tokens, mask)[:, 0]
        total = tokens.sum(dim=1)
        count = there.sum(dim=1).clamp(min=1.0)
        highest = tokens.masked_fill(~present[..., None], -1e4).amax(dim=1) * somewhere
        summary = torch.cat([pooled, total / count, highest, total / 20.0], dim=-1)
        return self.leave(self.norm(summary))
