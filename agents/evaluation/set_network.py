"""Set transformers over the objects of a scene: tokens, networks, and the frozen encoder of Fréchet distances."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.files import read_tensors, write_tensors
from scene_envs.rotations import quaternion_to_matrix
from scene_envs.scene import POSE_FEATURES, SceneBatch

NEIGHBOURS = 4
"""Neighbours described per object."""
NEIGHBOUR_FEATURES = 7
"""Numbers per neighbour: offset (3), gap per axis (3), gap of the horizontal outlines."""
WAVE_FEATURES = 26
"""Numbers of the Fourier features of a translation."""
FEATURES = 64
"""Features of a scene that a :class:`SetEncoder` gives."""
SHIPPED = Path(__file__).parent / "weights" / "set_encoder.safetensors"
"""File of the encoder that :func:`~agents.evaluation.pictures.frechet_scene_distance` uses."""

_OWN = 12 + WAVE_FEATURES + 3
"""Features of an object that a :class:`SetEncoder` reads."""
_HORIZONTAL_WAVES = (16.0, 4.0, 1.0)
_VERTICAL_WAVES = (2.56, 1.28, 0.64, 0.32, 0.16, 0.08, 0.04)
"""Wavelengths (m) of the Fourier features of x and y, and of z; those of z are finer: heights are few and exact."""
_NEAR = 0.005
"""Gaps (m) are given as asinh(gap / 0.005), which resolves millimetres around contact and stays small in a room."""
_TIE_BREAK = (7.1e-5, 5.3e-5, 3.1e-5)
"""Distance added per metre of offset. Objects that touch are equally near; without this term the order of slots would
choose between them."""
_FAR = 1e6
_CHUNK = 256
_PRIOR_COUNT = 4.0
"""Weight, in objects, of the variance over all groups in the variance of one group."""
_CLIP = 8.0
_MIN_STD = 1e-4


@dataclass(frozen=True)
class SceneTokens:
    """B scenes of up to N objects; rows past the objects of a scene are padding."""

    poses: Tensor  # (B, N, 12) translation (m) and rotation matrix row-major
    waves: Tensor  # (B, N, 26) Fourier features of the translation
    categories: Tensor  # (B, N) int64 asset, C where there is none
    extents: Tensor  # (B, N, 3) asset bounding box, m
    offsets: Tensor  # (B, N, K, 7) offsets to each of the nearest neighbours, see :func:`scene_tokens`
    neighbours: Tensor  # (B, N, K) int64 assets of these neighbours, C where there is none
    present: Tensor  # (B, N) bool, False for padding

    def __len__(self) -> int:
        return self.poses.shape[0]

    def __getitem__(self, index: Tensor | slice) -> SceneTokens:
        """Some of the scenes, with no more padding than they need."""
        picked = [getattr(self, field.name)[index] for field in fields(self)]
        longest = max(1, int(picked[-1].sum(dim=-1).max())) if picked[-1].shape[0] else 1
        return SceneTokens(*(part[:, :longest] for part in picked))


def scene_tokens(batch: SceneBatch, neighbours: int = NEIGHBOURS) -> SceneTokens:
    """Describe every object of every scene; the order of the slots affects only the order of the rows. The K
    ``neighbours`` of an object are those whose world-aligned boxes come nearest or overlap most; among equals, the
    nearest centres. Each has the offset of its frame, asinh(offset / 0.1 m), and as asinh(gap / 5 mm) the gaps of the
    boxes along x, y and z (negative for overlap) and of the circles around the outlines seen from above.
    """
    if not len(batch):
        raise InvalidInputError("a learned measure needs at least one scene, got none")
    parts = [_tokens(batch[start : start + _CHUNK], neighbours) for start in range(0, len(batch), _CHUNK)]
    width = max(part.poses.shape[1] for part in parts)
    empty = batch.scene_type.num_assets
    joined = []
    for field in fields(SceneTokens):
        fill = empty if field.name in ("categories", "neighbours") else 0
        joined.append(torch.cat([_padded(getattr(part, field.name), 1, width, fill) for part in parts]))
    return SceneTokens(*joined)


def blurred(
    batch: SceneBatch, translation: float | Tensor, rotation: float | Tensor, generator: torch.Generator
) -> SceneBatch:
    """The scenes with Gaussian noise on all poses, of standard deviation ``translation`` (m) and ``rotation`` (rad),
    numbers or tensors that broadcast to (B, N, 3); rotation vectors get the noise of rotations.
    """
    shape = batch.translations.shape
    shift = translation * torch.randn(shape, generator=generator)
    half = 0.5 * rotation * torch.randn(shape, generator=generator)
    turn = quaternion_to_matrix(torch.cat([torch.ones(*shape[:-1], 1), half], dim=-1))
    return batch.with_poses(batch.translations + shift, turn @ batch.rotations)


def _tokens(batch: SceneBatch, neighbours: int) -> SceneTokens:
    order = batch.is_empty.to(torch.uint8).argsort(dim=1, stable=True)[:, : max(1, int(batch.counts.max()))]
    categories = batch.categories.gather(1, order)
    poses = batch.tensor[..., :12].gather(1, order[..., None].expand(-1, -1, 12))
    present = categories != batch.scene_type.num_assets
    corners = np.stack([*(asset.bounds for asset in batch.scene_type.library), np.zeros((2, 3))])
    bounds = torch.tensor(corners, dtype=torch.float32)[categories]  # (B, N, 2, 3): lowest and highest, 0 for empty
    translations, rotations = poses[..., :3], poses[..., 3:].unflatten(-1, (3, 3))
    half = 0.5 * (bounds[..., 1, :] - bounds[..., 0, :])
    center = translations + (rotations @ bounds.mean(dim=-2)[..., None])[..., 0]
    reach = (rotations.abs() @ half[..., None])[..., 0]  # half extents of the box along world axes
    gap = (center[:, :, None] - center[:, None]).abs() - reach[:, :, None] - reach[:, None]  # (B, N, N, 3)
    offset = center[:, None] - center[:, :, None]  # to the column's object
    apart = gap.amax(dim=-1) + 0.01 * offset.norm(dim=-1) + (offset * torch.tensor(_TIE_BREAK)).sum(dim=-1)
    apart = apart.masked_fill(~present[:, None] | torch.eye(apart.shape[1], dtype=torch.bool), _FAR)
    count = min(neighbours, apart.shape[1])
    distance, nearest = apart.topk(count, dim=-1, largest=False)
    there = (distance < _FAR) & present[..., None]
    radius = half[..., :2].mean(dim=-1)
    shift = _at(translations, nearest) - translations[:, :, None]
    outline = (_at(center, nearest) - center[:, :, None])[..., :2].norm(dim=-1) - radius[:, :, None]
    outline = outline - _at(radius[..., None], nearest)[..., 0]
    gaps = gap.gather(2, nearest[..., None].expand(-1, -1, -1, 3))
    offsets = torch.cat(
        [torch.asinh(shift / 0.1), torch.asinh(gaps / _NEAR), torch.asinh(outline / _NEAR)[..., None]], dim=-1
    )
    names = _at(categories[..., None], nearest)[..., 0].masked_fill(~there, batch.scene_type.num_assets)
    return SceneTokens(
        poses,
        _waves(translations) * present[..., None],
        categories,
        2.0 * half,
        _padded(offsets * there[..., None], 2, neighbours, 0.0),
        _padded(names, 2, neighbours, batch.scene_type.num_assets),
        present,
    )


def _waves(translations: Tensor) -> Tensor:
    """(B, N, 26) sines and cosines of the coordinates."""
    parts = [
        2.0 * math.pi / torch.tensor(waves) * translations[..., axis, None]
        for axis, waves in enumerate((_HORIZONTAL_WAVES, _HORIZONTAL_WAVES, _VERTICAL_WAVES))
    ]
    angle = torch.cat(parts, dim=-1)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """Rows ``index`` (B, N, K) of ``values`` (B, N, F), as (B, N, K, F)."""
    rows = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, rows).unflatten(1, index.shape[1:])


def _padded(values: Tensor, dim: int, size: int, fill: float) -> Tensor:
    """``values`` with ``fill`` up to ``size`` along ``dim``."""
    return F.pad(values, [0, 0] * (values.ndim - 1 - dim) + [0, size - values.shape[dim]], value=fill)


@dataclass(frozen=True)
class SetNetworkConfig:
    """Size of a :class:`SetNetwork`."""

    features: int  # of an object
    categories: int  # tokens, those for *empty* and *unknown* included
    outputs: int  # for a scene
    hidden: int = 32  # width of the tokens, a multiple of ``heads``
    heads: int = 2
    blocks: int = 1  # of induced attention
    inducing: int = 8  # points per block
    dropout: float = 0.1  # share of the pooled features dropped in training
    pair_features: int = NEIGHBOUR_FEATURES  # of each neighbour of an object

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
    """Set Transformer (Lee et al. 2019) with induced attention: one token per object, which depends on the other
    objects and not on padding. Before the attention, a small MLP over pairs reads the nearest neighbours: overlaps and
    distances.
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
        pairs = F.gelu(self.pair(offsets) + self.pair_other(neighbours) + self.pair_self(categories)[:, :, None])
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
    It does not read ``outputs`` and ``dropout`` of the config.

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
    """Network with ``outputs`` numbers for a scene, invariant to the order of objects and to padding. The tokens of the
    objects are pooled by attention, mean, maximum and a scaled sum.

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
        """(B, ``outputs``) logits or features. Objects have features ``own`` (B, N, F) and ``categories`` (B, N), their
        neighbours ``offsets`` (B, N, K, P) and categories ``neighbours`` (B, N, K); ``present`` (B, N) is False for
        padding.
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


@dataclass(frozen=True)
class Moments:
    """Mean and standard deviation (G, F) of each of G groups."""

    mean: Tensor
    std: Tensor

    @classmethod
    def of(cls, values: Tensor, groups: Tensor, count: int) -> Moments:
        """From ``values`` (M, F) of ``groups`` (M,); the variance of rare groups shrinks to that within all groups."""
        values = values.double()
        size = torch.bincount(groups, minlength=count)[:, None].double()
        mean = torch.zeros(count, values.shape[-1], dtype=torch.float64).index_add(0, groups, values)
        mean = mean / size.clamp(min=1.0)
        squares = torch.zeros_like(mean).index_add(0, groups, (values - mean[groups]) ** 2)
        overall = squares.sum(dim=0) / size.sum().clamp(min=1.0)
        variance = (squares + _PRIOR_COUNT * overall) / (size + _PRIOR_COUNT)
        return cls(mean.float(), variance.sqrt().clamp(min=_MIN_STD).float())

    def deviations(self, values: Tensor, groups: Tensor) -> Tensor:
        """(..., 2 F): values in standard deviations from the mean of their group, and log(1 + their squares)."""
        scaled = (values - self.mean[groups]) / self.std[groups]
        return torch.cat([scaled.clamp(-_CLIP, _CLIP), scaled.square().log1p()], dim=-1)


@dataclass(frozen=True)
class TypicalPlaces:
    """Places of real objects: poses per asset, offsets to neighbours per pair of assets."""

    poses: Moments
    offsets: Moments
    width: int

    @classmethod
    def of(cls, real: SceneTokens, width: int) -> TypicalPlaces:
        """From real scenes of ``width`` categories, empty included."""
        there = real.neighbours != width - 1
        pairs = _pairs(real, width)[there]
        poses = Moments.of(real.poses[real.present], real.categories[real.present], width)
        return cls(poses, Moments.of(real.offsets[there], pairs, width * width), width)

    def network_config(self, outputs: int) -> SetNetworkConfig:
        """Size of a network that reads :meth:`inputs`."""
        features, pair_features = 2 * POSE_FEATURES + WAVE_FEATURES, 2 * NEIGHBOUR_FEATURES
        return SetNetworkConfig(features, self.width, outputs=outputs, pair_features=pair_features)

    def inputs(self, tokens: SceneTokens) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Arguments of a :class:`~agents.evaluation.set_network.SetNetwork` for these scenes."""
        there = (tokens.neighbours != self.width - 1)[..., None]
        pairs = self.offsets.deviations(tokens.offsets, _pairs(tokens, self.width)) * there  # (B, N, K, 14)
        own = torch.cat([self.poses.deviations(tokens.poses, tokens.categories), tokens.waves], dim=-1)
        return own, tokens.categories, pairs, tokens.neighbours, tokens.present


def _pairs(tokens: SceneTokens, width: int) -> Tensor:
    """(B, N, K) index of the ordered pair of assets."""
    return tokens.categories[..., None] * width + tokens.neighbours


class SetEncoder(nn.Module):
    """Encoder of scenes of any type to 64 features; invariant to the order of slots and to empty slots. It reads
    categories by asset name, so a scene has the same features in a union of types as in its own type. Of an asset
    outside ``vocabulary`` it reads the bounding box but no name, so distances of users' own assets depend on sizes,
    poses and gaps. ``config`` None takes the sizes of the shipped network.

    >>> encoder = SetEncoder(("cafe_table", "teacup")).eval()
    >>> encoder.features(SceneBatch.empty("dimsum_table", 2)).shape
    torch.Size([2, 64])
    """

    def __init__(self, vocabulary: Sequence[str], config: SetNetworkConfig | None = None) -> None:
        super().__init__()
        self.vocabulary = tuple(vocabulary)
        self.config = config or SetNetworkConfig(
            _OWN, len(self.vocabulary) + 2, FEATURES, hidden=64, heads=2, blocks=1, dropout=0.0
        )
        self.network = SetNetwork(self.config)
        self.mean: Tensor
        self.whitening: Tensor
        self.register_buffer("mean", torch.zeros(self.config.outputs))
        self.register_buffer("whitening", torch.eye(self.config.outputs))

    @property
    def unknown(self) -> int:
        """Token of an asset outside the vocabulary."""
        return len(self.vocabulary)

    def names(self, batch: SceneBatch) -> Tensor:
        """(C + 1,) int64: the token of each category of the batch's scene type, empty last."""
        index = {name: token for token, name in enumerate(self.vocabulary)}
        tokens = [index.get(name, self.unknown) for name in batch.scene_type.assets]
        return torch.tensor([*tokens, self.unknown + 1])

    def forward(self, tokens: SceneTokens, names: Tensor) -> Tensor:
        """Features (B, F) before whitening; ``names`` (C + 1,) gives the token of each category."""
        size = (tokens.extents.clamp(min=1e-3) / 0.1).log() * tokens.present[..., None]
        own = torch.cat([tokens.poses, tokens.waves, size], dim=-1)
        return self.network(own, names[tokens.categories], tokens.offsets, names[tokens.neighbours], tokens.present)

    @torch.no_grad()
    def features(self, batch: SceneBatch) -> Tensor:
        """(B, F) float32 whitened features, on the CPU."""
        was_training = self.training
        self.eval()
        names = self.names(batch)
        parts = [batch[start : start + _CHUNK].to("cpu") for start in range(0, len(batch), _CHUNK)]
        raw = torch.cat([self(scene_tokens(part), names) for part in parts]) if parts else torch.empty(0, FEATURES)
        self.train(was_training)
        return (raw - self.mean) @ self.whitening

    def save(self, path: str | os.PathLike[str], note: str = "") -> Path:
        """Write weights (float16; mean and whitening float32), vocabulary, size and ``note``, a sentence on the
        training, to one ``.safetensors`` file.
        """
        weights = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        weights = {name: value.half() if name.startswith("network.") else value for name, value in weights.items()}
        metadata = {"vocabulary": json.dumps(self.vocabulary), "config": json.dumps(asdict(self.config)), "note": note}
        return write_tensors(path, weights, metadata)

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None) -> SetEncoder:
        """The encoder in ``path`` (None: the shipped one), frozen and in evaluation mode; an InvalidInputError if there
        is no such file, a CorruptFileError if :meth:`save` did not write it.
        """
        return _load(str(SHIPPED if path is None else Path(path).resolve()))


@cache
def _load(path: str) -> SetEncoder:
    try:
        weights, metadata = read_tensors(path)
        encoder = SetEncoder(json.loads(metadata["vocabulary"]), SetNetworkConfig(**json.loads(metadata["config"])))
        encoder.load_state_dict({name: value.float() for name, value in weights.items()})
    except FileNotFoundError:
        raise InvalidInputError(f"no set encoder at {path!r}; train_set_encoder makes one") from None
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CorruptFileError(f"{path!r} is not a set encoder written by SetEncoder.save: {error}") from error
    return encoder.eval().requires_grad_(False)
