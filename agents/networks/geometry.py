"""Modules of the Flux core that read geometry: rotations, relations between slots, and contacts between objects.

A denoiser of the nine entries of a matrix has to learn that they form a rotation, and that most objects stand upright.
Both show in differences as small as the noise, which a network that reads the entries alone learns last: where objects
of a category lie flat in one place and lean in another, its samples lie flat only to ten degrees. *Rotation features*
are these differences in units of the noise.

A transformer that reads positions slot by slot has to learn distances by itself. *Relations* are features of pairs of
slots. They bias the attention logits, and attention sums them with the weights with which it sums the values, so that a
head learns the offsets of its neighbours (as with the edges of graph transformers, Dwivedi and Bresson 2021, and in the
structure module of AlphaFold, Jumper et al. 2021).

Objects do not overlap, and stand on each other, to within a fraction of a millimetre. The distance between the centres
of two touching objects depends on both categories and on the direction, and on hardly anything else. *Contacts* learn
this distance with a small network on pairs of slots. A gap is the actual distance minus the learned one, in units of
the noise, because a denoiser can move objects only on the scale of the noise. Messages and displacements are computed
from the gaps.

Where the noise is centimetres, overlaps show in the denoised scene, not in the noisy one. A *refinement* reads
relations and contacts of the denoised scene, and corrects its poses with one more block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_modules import FluxModule, ModuleConfig, Scene, start_at_zero
from scene_envs.errors import unknown_name
from scene_envs.normalizer import constant_on
from scene_envs.rotations import quaternion_to_matrix
from scene_envs.scene import POSE_FEATURES

# -- rotations ------------------------------------------------------------------------------------


ROTATION_FEATURES = 9 + 4
"""Numbers per rotation."""
_TILTS = torch.tensor([6, 7, 2, 5])
"""Entries R_20, R_21, R_02 and R_12 of a row-major matrix."""
_MIN_ROTATION_NOISE = 1e-4
_TILT_REACH = 4.0  # standard deviations at which the distance from upright saturates


@dataclass(frozen=True)
class RotationFeaturesConfig(ModuleConfig):
    """Features of rotations, read with each pose and added, through gates, to the output of rotations."""

    name = "rotation_features"
    place = "output"
    reads_geometry = True
    reads_rotations = True

    @property
    def pose_width(self) -> int:
        return ROTATION_FEATURES

    def build(self, core: Any) -> RotationFeatures:
        return RotationFeatures(core.embedding)


class RotationFeatures(FluxModule):
    """Features (B, N, :data:`ROTATION_FEATURES`) of rotations, and gates on them that start at zero.

    With gates from the features to the output, the blocks need not carry thirteen noisy numbers for every object. The
    network only has to predict which features count, and this depends on the category and on where the object lies.
    """

    def __init__(self, embedding: int) -> None:
        super().__init__()
        self.gates = nn.Linear(embedding, ROTATION_FEATURES)
        start_at_zero(self.gates)

    def pose_features(self, scene: Scene) -> Tensor | None:
        if scene.noisy_rotation is None or scene.rotation is None or scene.rotation_noise is None:
            return None
        turns = rotation_features(scene.noisy_rotation, scene.rotation, scene.rotation_noise)
        scene.kept[RotationFeaturesConfig.name] = turns
        return turns

    def pose_output(self, scene: Scene, features: Tensor) -> Tensor | None:
        turns = scene.kept.get(RotationFeaturesConfig.name)
        if turns is None:
            return None
        off, tilt = (turns * self.gates(features)).split([9, 4], dim=-1)
        return F.pad(off.index_add(-1, constant_on(_TILTS, off.device), tilt), (3, 0))


_POWER = 64
"""Power of the matrix of a quaternion, taken twice: its largest eigenvalue is then the only one that is left."""


@torch.no_grad()
def nearest_rotations(rotation: Tensor) -> Tensor:
    """The rotations that are nearest to noisy matrices (B, N, 3, 3); the identity where all entries are NaN.

    The quaternion is the eigenvector of the largest eigenvalue of a symmetric matrix (Davenport; Horn 1987, section 4).
    Squaring the matrix again and again finds it with products alone, which a GPU can capture; an SVD is none.
    """
    with torch.autocast(rotation.device.type, enabled=False):
        wide = rotation.nan_to_num().double()
        xx, xy, xz, yx, yy, yz, zx, zy, zz = wide.flatten(-2).unbind(-1)
        entries = [
            xx + yy + zz, zy - yz, xz - zx, yx - xy, zy - yz, xx - yy - zz, xy + yx, xz + zx,
            xz - zx, xy + yx, yy - xx - zz, yz + zy, yx - xy, xz + zx, yz + zy, zz - xx - yy,
        ]  # fmt: skip
        square = torch.stack(entries, dim=-1).unflatten(-1, (4, 4)).flatten(0, -3)
        square = square / (2.0 * torch.linalg.matrix_norm(wide).flatten()[:, None, None] + 1e-9)
        square.diagonal(dim1=-2, dim2=-1).add_(0.9)  # positive
        square[:, 0, 0] += 1e-14
        for _ in range(2):  # the trace is at least 1/4 of the square of the former one, so that doubles suffice
            square = torch.linalg.matrix_power(square, _POWER)
            square = square / square.diagonal(dim1=-2, dim2=-1).sum(dim=-1)[:, None, None]
        best = square.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
        quaternion = square.gather(-1, best[:, None, None].expand(-1, 4, 1)).view(*wide.shape[:-2], 4)
        return quaternion_to_matrix(quaternion).to(rotation if rotation.dtype == torch.float64 else torch.float32)


@torch.no_grad()
def rotation_features(rotation: Tensor, nearest: Tensor, noise: Tensor) -> Tensor:
    """Differences of matrices from SO(3), and of the nearest rotations from upright, (B, N, :data:`ROTATION_FEATURES`).

    Args:
        rotation: (B, N, 3, 3) noisy rotation matrices.
        nearest: (B, N, 3, 3) their nearest rotations, from :func:`nearest_rotations`.
        noise: (B, N) standard deviation of the noise on the entries of ``rotation``.

    Returns:
        The residual of the projection onto SO(3), row-major, divided by the noise; three of the nine dimensions of the
        noise are not in it. Then R_20, R_21, R_02 and R_12 of the projection, divided by the noise and saturating. They
        are 0 where the z-axes of object and world are parallel. No gradient passes.

    >>> upright = torch.eye(3).expand(1, 2, 3, 3)
    >>> rotation_features(upright, nearest_rotations(upright), torch.full((1, 2), 0.1)).abs().max() < 1e-5
    tensor(True)
    """
    level = noise.to(nearest).clamp(min=_MIN_ROTATION_NOISE)[..., None]
    off = (rotation.to(nearest) - nearest).flatten(-2) / level
    tilt = nearest.flatten(-2).index_select(-1, constant_on(_TILTS, nearest.device))
    return torch.cat([off, tilt / (level.square() + (tilt / _TILT_REACH).square()).sqrt()], dim=-1)


# -- relations between slots ----------------------------------------------------------------------


_SCALES = 8
PAIR_FEATURES = 5 * _SCALES
"""Numbers per pair of slots."""
_PAIR_WIDTH = 32
"""Width of the networks on pairs."""
BLURS = ("axis", "largest")
"""The noise that blurs the features of an axis: that of the axis itself, or the largest of all axes."""


@dataclass(frozen=True)
class RelationsConfig(ModuleConfig):
    """Attention between slots that sees where the others stand.

    Attributes:
        blur: the noise that blurs features of an axis, one of :data:`BLURS`; see :class:`Relations`.
    """

    blur: str = "axis"

    name = "relations"
    place = "attention"
    reads_geometry = True

    def __post_init__(self) -> None:
        if self.blur not in BLURS:
            raise unknown_name("blur", self.blur, BLURS)

    @property
    def pair_width(self) -> int:
        return PAIR_FEATURES

    def build(self, core: Any) -> Relations:
        return Relations(core.blocks, core.heads, core.unit, blur=self.blur)


def pair_features(metres: Tensor, noise: Tensor, scales: Tensor) -> Tensor:
    """Features of every pair of slots, (B, N, N, F); entry (i, j) is of the offset from slot j to slot i.

    They are Gaussians of the horizontal distance and of the difference in height at every scale, then the offsets along
    z, x and y, which saturate beyond each scale. All are blurred by the noise on the two positions: E exp(-d^2 / 2 l^2)
    under Gaussian noise is a wider Gaussian.

    Args:
        metres: (B, N, 3) positions.
        noise: (B, N, 3) standard deviation of the noise on them along x, y, z, metres; (B, N, 1) if equal for all axes.
        scales: (8,) lengths, metres.
    """
    place, variance = metres.movedim(-1, 0).contiguous(), noise.movedim(-1, 0).contiguous().square()
    wide = scales.square().view(-1, 1, 1, 1)
    x, y, z = (place.unsqueeze(-1) - place.unsqueeze(-2)).split(1)  # (1, B, N, N)
    blurs = (variance.unsqueeze(-1) + variance.unsqueeze(-2)).split(1)
    along_x, along_y, along_z = [blur + wide for blur in blurs] if len(blurs) == 3 else [blurs[0] + wide] * 3  # (8, ...
    xx, yy, zz = x.square(), y.square(), z.square()
    halves = [-0.5 * square for square in (xx, yy, zz)]
    reach_x = (xx + yy + along_x).sqrt()
    reach_y = reach_x if along_y is along_x else (xx + yy + along_y).sqrt()
    parts = [_gaussian((halves[0] / along_x).add_(halves[1] / along_y)), _gaussian(halves[2] / along_z)]
    return torch.cat([*parts, z / (zz + along_z).sqrt(), x / reach_x, y / reach_y]).movedim(0, -1)


_LEAST = -60.0  # least exponent of a feature


def _gaussian(exponent: Tensor) -> Tensor:
    """exp(x), at least 1e-26: products of numbers below 1e-38 take a processor many times as long as others. Overwrites
    ``exponent``.
    """
    return exponent.clamp_(min=_LEAST).exp_()


def linear_of_pairs(layer: nn.Linear, pairs: Tensor) -> Tensor:
    """A linear layer on features of pairs (F, B, N, N), which are in front so that products read long rows."""
    result = torch.addmm(layer.bias[:, None], layer.weight, pairs.flatten(1))
    return result.unflatten(1, pairs.shape[1:])


class Relations(FluxModule):
    """Features of pairs of slots, and the biases that every attention block makes of them.

    Permutation-equivariant. Positions are read in normalised units; features are computed in metres.

    Args:
        blocks: attention blocks.
        heads: heads per block.
        unit: metres per normalised unit along x, y, z; 0 along an axis that never varies.
        blur: the noise that blurs features of an axis: ``"axis"`` for the noise of the axis itself, ``"largest"`` for
            the largest noise of all axes, which is too large for heights in rooms.

    >>> relations = Relations(blocks=2, heads=4, unit=(0.5, 0.5, 0.5))
    >>> bias, features = relations(torch.zeros(3, 5, 3), torch.ones(3, 5))
    >>> bias.shape, features.shape
    (torch.Size([2, 3, 4, 5, 5]), torch.Size([3, 5, 5, 40]))
    """

    def __init__(self, blocks: int, heads: int, unit: tuple[float, float, float], blur: str = "axis") -> None:
        super().__init__()
        self.blocks, self.heads, self.blur = blocks, heads, blur
        largest = torch.tensor(max(*unit, 0.1))
        self.unit: Tensor
        self.scales: Tensor
        self.register_buffer("unit", torch.tensor(unit), persistent=False)
        self.register_buffer("scales", torch.logspace(-2, float(largest.log10()), _SCALES), persistent=False)
        self.hidden = nn.Linear(3 * _SCALES, _PAIR_WIDTH)
        self.out = nn.Linear(_PAIR_WIDTH, blocks * heads)
        start_at_zero(self.out)

    def relations(self, scene: Scene) -> tuple[Tensor, Tensor] | None:
        if scene.position is None or scene.noise_level is None:
            return None
        return self(scene.position[..., :3], scene.noise_level)  # type: ignore[no-any-return]

    def forward(self, position: Tensor, noise_level: Tensor) -> tuple[Tensor, Tensor]:
        """Biases (blocks, B, heads, N, N) and features (B, N, N, :data:`PAIR_FEATURES`).

        Args:
            position: (B, N, 3), normalised.
            noise_level: (B, N) noise on the positions, in the same units.
        """
        unit = self.unit.to(position)
        blurred = unit if self.blur == "axis" else unit.max().reshape(1)
        features = pair_features(position * unit, noise_level.unsqueeze(-1) * blurred, self.scales.to(position))
        seen = features.movedim(-1, 0)[: 3 * _SCALES]
        inside = F.silu(linear_of_pairs(self.hidden, seen), inplace=not torch.is_grad_enabled())
        bias = linear_of_pairs(self.out, inside)
        return bias.unflatten(0, (self.blocks, self.heads)).transpose(1, 2), features


def joint_attention(
    query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, relations: Tensor | None, gathered: nn.Linear | None
) -> Tensor:
    """Attention over T tokens, (B, T, H), plus a linear map of ``relations``, summed with the attention weights.

    Args:
        query, key, value: (B, heads, T, H / heads).
        mask: mask of :func:`torch.nn.functional.scaled_dot_product_attention`; a float one with ``relations``.
        relations: (B, N, N, F) features of pairs of the last N tokens, the slots; None for none.
        gathered: linear map from heads * F to H.
    """
    if relations is None or gathered is None or mask is None:
        return F.scaled_dot_product_attention(query, key, value, attn_mask=mask).transpose(1, 2).flatten(-2)
    batch, heads, asking, width = query.shape
    asked, slots, features = key.shape[2], *relations.shape[2:]
    weights = torch.baddbmm(
        mask.expand(batch, heads, asking, asked).reshape(-1, asking, asked), query.reshape(-1, asking, width),
        key.reshape(-1, asked, width).mT, alpha=width**-0.5,
    ).softmax(dim=-1)  # fmt: skip
    attended = torch.bmm(weights, value.reshape(-1, asked, width)).view(batch, heads, asking, width)
    attended = attended.transpose(1, 2).reshape(batch, asking, -1)
    among = weights.view(batch, heads, asking, asked)[:, :, -slots:, -slots:].transpose(1, 2)  # (B, N, heads, N)
    message = torch.bmm(among.reshape(-1, heads, slots), relations.reshape(-1, slots, features))
    message = gathered(message.view(batch, slots, -1))
    others = asking - slots
    return attended + (F.pad(message, (0, 0, others, 0)) if others else message)


# -- contacts -------------------------------------------------------------------------------------


CHANNELS = 4
"""Number of displacements of every slot."""
_GAPS = 8  # of a pair: horizontal, in height, along the three axes of i, along those of j
_DIRECTIONS = 6
_BASIS = 3  # functions of each gap that a layer reads
_GAP_REACH = 4.0
_GAP_OF = (0, 0, 1, 2, 3, 4, 5, 5, 5, 6, 6, 6, 7, 7, 7)
"""The gap of each component of ``ways``: x, y, z of the world, the axes of i, and x, y, z of each axis of j."""
_TYPICAL = 0.1  # metres between the centres of objects that touch
_MIN_NOISE = 2e-4  # metres


@dataclass(frozen=True)
class ContactsConfig(ModuleConfig):
    """Displacements along the gaps between objects; reads the features of pairs that relations offer."""

    name = "contacts"
    place = "output"
    requires = ("relations",)
    reads_geometry = True
    reads_rotations = True

    def build(self, core: Any) -> Contacts:
        return Contacts(core.categories, core.pair_width, core.hidden, core.embedding)


class Contacts(FluxModule):
    """Messages between slots about the gaps between them, and displacements along these gaps.

    Permutation-equivariant. For slots i and j, a network predicts the distances at which the two objects touch:
    horizontally, in height, and along the axes of each object. It reads the features of the pair, the horizontal
    direction between the objects in the frame of each, and both categories. A gap is the actual distance minus the
    predicted one, divided by the noise on both positions along the gap. This noise differs by axis, because normalised
    units do. A second network computes the messages and the amplitudes of the displacements from the gaps. Each axis
    takes the part of a displacement that corresponds to its share of the noise along the gap, as in the posterior mean
    under such noise.

    A slot whose category is masked gets no message. Otherwise the network would take a masked slot that overlaps
    another object for empty. This is right in real scenes with noise on them. In samples, however, it removes objects
    that are only slightly misplaced.

    Args:
        categories: K = C + 1; the mask token is one more.
        features: numbers per pair of slots, from :class:`~agents.networks.geometry.Relations`.
        hidden: width of the messages.
        embedding: width of the features from which the gates of the displacements are computed.

    >>> contacts = Contacts(categories=3, features=40, hidden=16, embedding=16)
    >>> metres, rotation = torch.randn(2, 5, 3), torch.eye(3).expand(2, 5, 3, 3)
    >>> states, noise, features = torch.zeros(2, 5).long(), torch.full((2, 5, 3), 0.1), torch.zeros(2, 5, 5, 40)
    >>> messages, displacements = contacts(metres, rotation, states, noise, features)
    >>> messages.shape, displacements.shape
    (torch.Size([2, 5, 16]), torch.Size([2, 5, 4, 3]))
    """

    def __init__(self, categories: int, features: int, hidden: int, embedding: int) -> None:
        super().__init__()
        width, kind = _PAIR_WIDTH, 16
        self.kind = nn.Embedding(categories + 1, kind)
        self.seen = nn.Linear(features + 2 * _DIRECTIONS, width)
        self.own, self.other = (nn.Linear(kind, 2 * width, bias=False) for _ in range(2))
        self.touch = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, _GAPS))
        self.weigh = nn.Linear(width + _BASIS * _GAPS + 1, width)
        self.second = nn.Linear(width, width)
        self.amplitudes = nn.Linear(width, CHANNELS * 2 * _GAPS)
        self.out = nn.Linear(width, hidden)
        self.gates = nn.Linear(embedding, 3 * CHANNELS)
        self.gap_of: Tensor
        self.register_buffer("gap_of", torch.tensor(_GAP_OF), persistent=False)
        start_at_zero(self.out, self.gates)

    def messages(self, scene: Scene) -> Tensor | None:
        if scene.metres is None or scene.metres_noise is None or scene.rotation is None or scene.pairs is None:
            return None
        metres, rotation = scene.metres, scene.rotation.to(scene.metres)
        with torch.autocast(metres.device.type, enabled=False):  # an error of half a percent of a metre is too large
            messages, moves = self(metres, rotation, scene.states, scene.metres_noise, scene.pairs, scene.slot_mask)
        scene.kept[ContactsConfig.name] = moves
        return messages

    def pose_output(self, scene: Scene, features: Tensor) -> Tensor | None:
        moves = scene.kept.get(ContactsConfig.name)
        return None if moves is None else F.pad(gated_displacement(moves, self.gates(features)), (0, 9))

    def forward(
        self, metres: Tensor, rotation: Tensor, states: Tensor, noise: Tensor, features: Tensor,
        slot_mask: Tensor | None = None, extents: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Messages (B, N, H) to slots, and displacements (B, N, :data:`CHANNELS`, 3) in units of the noise.

        Args:
            metres: (B, N, 3) noisy positions.
            rotation: (B, N, 3, 3) rotation matrices, such as the nearest to noisy matrices; their columns must be unit
                vectors.
            states: (B, N) int64 categories, mask tokens among them.
            noise: (B, N, 3) standard deviation of the noise on positions along x, y, z, metres.
            features: (B, N, N, F) of pairs of slots.
            slot_mask: (B, N) bool, False for padding slots, which nothing may see; None where there are none.
            extents: half sizes (B, N, 3) of the objects along their axes, metres, and roundness (B, N) in 0..1, of
                :func:`reach`: what the network predicts is then added to the sum of the extents along each gap.
        """
        place, spread = metres.movedim(-1, 0).contiguous(), noise.movedim(-1, 0).contiguous().square()
        offset = place.unsqueeze(-1) - place.unsqueeze(-2)  # (3, B, N, N) from j to i
        variance = spread.unsqueeze(-1) + (spread + _MIN_NOISE**2).unsqueeze(-2)
        turns = rotation.movedim((-2, -1), (0, 1)).contiguous()  # rows of slots j are then read at once
        mine, theirs = turns.unsqueeze(-1), turns.unsqueeze(-2)  # (3, 3, B, N, 1) of i, (3, 3, B, 1, N) of j
        squared = offset[:2].square()
        sideways = (squared[:1] + squared[1:] + 1e-12).sqrt()
        toward = offset[:2] / sideways
        along = torch.cat([sideways, offset[2:], _turned(offset, mine), _turned(offset, theirs)])  # (GAPS, B, N, N)
        level = toward.square() * variance[:2]
        level = level[:1] + level[1:]
        squares = [_turned(variance, turn.square()) for turn in (mine, theirs)]
        both = (
            torch.cat([level, variance[2:], *squares]).clamp_(min=_MIN_NOISE**2).sqrt()
        )  # (GAPS, ...) noise along each
        sign = along / torch.hypot(along, both)
        aside = toward * sign[:1]
        kinds = self.kind(states)
        own, other = (layer(kinds).movedim(-1, 0).contiguous() for layer in (self.own, self.other))  # (2 W, B, N)
        own = own + torch.cat([self.seen.bias, self.weigh.bias])[:, None, None]
        (early, late), (early_other, late_other) = own.unsqueeze(-1).chunk(2), other.unsqueeze(-2).chunk(2)
        here = _turned(aside, mine[:2])  # the direction from j to i in the frame of i, and from i to j in that of j
        there = _turned(-aside, theirs[:2])
        shape, fresh = both.shape[1:], not torch.is_grad_enabled()
        seen = _product(self.seen.weight, features.movedim(-1, 0), here, here.square(), there, there.square())
        seen = F.silu(seen.unflatten(1, shape).add_(early).add_(early_other), fresh)
        first, last = (layer for layer in self.touch if isinstance(layer, nn.Linear))
        offered = F.silu(linear_of_pairs(first, seen), fresh).flatten(1)
        bias = last.bias[:, None, None, None]
        level = along.abs() - (_TYPICAL * (1.0 + bias) if extents is None else reach(turns, toward, *extents))
        level = level if extents is None else level - _TYPICAL * bias
        gaps = level.flatten(1).addmm_(last.weight, offered, alpha=-_TYPICAL).unflatten(1, shape) / both
        bounded = gaps / (1.0 + (gaps / _GAP_REACH).square()).sqrt()
        steps = (-2.0 * gaps).clamp_(min=_LEAST).sigmoid()
        weighed = _product(self.weigh.weight, seen, bounded, steps, _gaussian(-0.5 * gaps.square()), both[:1].log())
        weighed = F.silu(weighed.unflatten(1, shape).add_(late).add_(late_other), fresh)
        weighed = F.silu(linear_of_pairs(self.second, weighed), fresh)
        present = (1.0 - torch.eye(states.shape[1], dtype=both.dtype, device=both.device)).expand_as(both[0])
        present = present if slot_mask is None else present * slot_mask.unsqueeze(1)
        sign, aside = sign / both * present, aside * present
        parts = [aside / both[:1], sign[1:5], sign[5:, None] * turns.transpose(0, 1).contiguous().unsqueeze(-2)]
        parts += [part * gap for part, gap in zip(parts, (bounded[:1], bounded[1:5], bounded[5:, None]), strict=True)]
        ways = torch.cat([*(part.reshape(-1, *shape) for part in parts), present.unsqueeze(0)])
        gathered = weighed.movedim(0, -2) @ ways.permute(1, 2, 3, 0)  # (B, N, W, 2 * 15 + 1), summed over other slots
        moves = self._displacements(gathered[..., :-1], ways[:-1].sum(dim=-1).movedim(0, -1), rotation)
        moves = math.sqrt(2) * noise.unsqueeze(-2) * moves
        visible = (states < self.kind.num_embeddings - 1).unsqueeze(-1)
        return self.out(gathered[..., -1]) * visible, moves

    def _displacements(self, gathered: Tensor, plain: Tensor, rotation: Tensor) -> Tensor:
        """Displacements (B, N, CHANNELS, 3): per gap one amplitude plus another times the gap, summed over other slots.

        Amplitudes are linear in the weights of pairs, so the sum over other slots is taken first. Then the cost per
        pair does not grow with CHANNELS. ``gathered`` (B, N, W, 2 * 15) are the ways of the gaps, then those times the
        gaps, summed with the weights; ``plain`` (B, N, 2 * 15) are summed without.
        """
        gathered = torch.cat([gathered, plain.unsqueeze(-2)], dim=-2)
        amplitudes = torch.cat([self.amplitudes.weight, self.amplitudes.bias[:, None]], dim=1)
        amplitudes = amplitudes.unflatten(0, (2, CHANNELS, _GAPS)).index_select(2, self.gap_of)  # (2, C, 15, W + 1)
        moves = torch.einsum("biusq,scqu->bicq", gathered.unflatten(-1, (2, -1)), amplitudes)
        level, own, others = moves.split([3, 3, 9], dim=-1)
        return level + own @ rotation.mT + others.unflatten(-1, (3, 3)).sum(dim=-2)


def reach(turns: Tensor, toward: Tensor, half: Tensor, roundness: Tensor) -> Tensor:
    """Sum of the extents of two objects along each of their gaps, (8, B, N, N), metres.

    Along a unit vector d, a box with half sizes h and axes a reaches sum |h_k a_k d| from its centre, and an ellipsoid
    sqrt(sum (h_k a_k d)^2); the latter is the radius of an upright cylinder. ``roundness`` mixes the two.

    Args:
        turns: (3, 3, B, N) rotation matrices; columns are the axes of the objects.
        toward: (2, B, N, N) horizontal unit vectors from slot j to slot i.
        half: (B, N, 3) half sizes.
        roundness: (B, N), 0 for a box, 1 for an ellipsoid.

    >>> turns, toward = torch.eye(3).view(3, 3, 1, 1).expand(3, 3, 1, 2), torch.tensor([1.0, 0.0]).view(2, 1, 1, 1)
    >>> sizes = torch.tensor([[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]])
    >>> [round(float(x), 3) for x in reach(turns, toward.expand(2, 1, 2, 2), sizes, torch.zeros(1, 2))[:5, 0, 0, 1]]
    [0.5, 0.9, 0.5, 0.7, 0.9]
    """
    mine, theirs = turns.unsqueeze(-1), turns.unsqueeze(-2)
    sizes = half.movedim(-1, 0)
    own, other = sizes.unsqueeze(-1), sizes.unsqueeze(-2)
    own_round, other_round = roundness.unsqueeze(-1), roundness.unsqueeze(-2)

    def extent(parts: Tensor, share: Tensor) -> Tensor:
        box, ellipsoid = parts.abs().sum(dim=0), (parts.square().sum(dim=0) + 1e-12).sqrt()
        return torch.lerp(box, ellipsoid, share.expand_as(box))

    level = extent(own * _turned(toward, mine[:2]), own_round)
    level = level + extent(other * _turned(toward, theirs[:2]), other_round)
    height = extent(sizes * turns[2], roundness)
    cosines = (mine.unsqueeze(2) * theirs.unsqueeze(1)).sum(dim=0)  # (3 axes of i, 3 of j, B, N, N)
    along_own = [own[k] + extent(other * cosines[k], other_round) for k in range(3)]
    along_other = [other[k] + extent(own * cosines[:, k], own_round) for k in range(3)]
    return torch.stack([level, height.unsqueeze(-1) + height.unsqueeze(-2), *along_own, *along_other])


def _product(weight: Tensor, wide: Tensor, *others: Tensor) -> Tensor:
    """(O, B * N * N) product of ``weight`` (O, F) with features of pairs; the first, ``wide``, is not copied."""
    width = len(wide)
    result = weight[:, :width] @ wide.flatten(1)
    return result.addmm_(weight[:, width:], torch.cat(others).flatten(1))


def _turned(vectors: Tensor, turns: Tensor) -> Tensor:
    """Vectors (W, B, N, N) of the world along the three axes of frames (W, 3, B, N or 1, 1 or N): (3, B, N, N)."""
    result = vectors[0] * turns[0]
    for vector, turn in zip(vectors[1:], turns[1:], strict=True):
        result = torch.addcmul(result, vector, turn)
    return result


def gated_displacement(displacements: Tensor, gates: Tensor) -> Tensor:
    """Contribution (B, N, 3) of displacements (B, N, C, 3) to the translation output, with gates (B, N, C * 3)."""
    return (displacements * gates.unflatten(-1, (CHANNELS, 3))).sum(dim=-2)


# -- refinement -----------------------------------------------------------------------------------


_ESTIMATE_NOISE = 0.7
"""Error of a denoised position over the noise on it, for each axis (Living Room Shelf: 0.65 to 0.74 below 0.3)."""
_MAX_ERROR = 0.04
"""Largest error of a denoised horizontal position that a refinement corrects, m; guidance moves objects up to 0.03."""


@dataclass(frozen=True)
class RefinementConfig(ModuleConfig):
    """One more block, on the denoised scene, that corrects the poses.

    Attributes:
        shapes: for each asset the centre of its bounding box and its half sizes, in the frame of the asset, metres.
    """

    shapes: tuple[tuple[float, ...], ...]

    name = "refinement"
    place = "output"
    requires = ("relations",)
    reads_geometry = True
    reads_rotations = True
    reads_estimate = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "shapes", tuple(tuple(shape) for shape in self.shapes))  # lists, when from JSON

    def build(self, core: Any) -> Refinement:
        return Refinement(self.shapes, core)


class Refinement(FluxModule):
    """Correction (B, N, 12) of the pose output, from relations and contacts of the scene that this output denoises.

    The contacts know the bounding boxes of the assets, see :func:`reach`. No gradient passes through the denoised
    scene. Logits are not changed, nor slots without noise or with an error of denoised positions above 4 cm.

    Args:
        shapes: of :class:`RefinementConfig`.
        core: configuration of the network.
    """

    def __init__(self, shapes: tuple[tuple[float, ...], ...], core: Any) -> None:
        super().__init__()
        hidden, width = core.hidden, core.embedding
        self.near = Relations(1, core.heads, core.unit)
        self.touching = Contacts(core.categories, PAIR_FEATURES, hidden, width)
        self.roundness = nn.Embedding(core.categories + 1, 1)
        self.output_in = nn.Linear(POSE_FEATURES, hidden, bias=False)
        self.block = core.block(PAIR_FEATURES)
        self.final_modulation = nn.Linear(hidden, 2 * hidden)
        self.final = nn.Linear(hidden, width)
        self.pose_out = nn.Sequential(
            nn.Linear(width, core.pose_head), nn.SiLU(), nn.Linear(core.pose_head, POSE_FEATURES)
        )
        start_at_zero(self.roundness, self.touching.touch[-1], self.output_in, self.final_modulation, self.pose_out[-1])
        boxes = torch.zeros(core.categories + 1, 6)  # neither an empty slot nor a masked one has a size
        boxes[: len(shapes)] = torch.tensor(shapes)
        self.boxes: Tensor
        self.unit: Tensor
        self.rotations: Tensor
        self.register_buffer("boxes", boxes, persistent=False)
        self.register_buffer("unit", torch.tensor(core.unit), persistent=False)
        self.register_buffer("rotations", torch.tensor(core.rotations), persistent=False)

    def start_like(self, network: Any) -> None:
        """Take the network's relations, contacts if it has them, last block and last layers; the correction is 0."""
        fresh = ("out.", "gates.", "touch.2.")  # these are 0 at the start
        parts: list[tuple[nn.Module, Any]] = [
            (self.near, network.relations), (self.block, network.single_blocks[-1]), (self.final, network.final),
            (self.final_modulation, network.final_modulation), (self.pose_out[0], network.pose_out[0]),
        ]  # fmt: skip
        if hasattr(network, "contacts"):
            parts.append((self.touching, network.contacts))
        for own, trained in parts:
            weights = trained.state_dict()
            own.load_state_dict({k: v for k, v in weights.items() if not k.startswith(fresh)}, strict=False)

    def correction(self, scene: Scene, tokens: Tensor, condition: Tensor, output: Tensor) -> Tensor | None:
        if scene.estimate is None or scene.position is None or scene.noise_level is None:
            return None
        noise = _ESTIMATE_NOISE * scene.noise_level
        near_clean = (noise[..., None] * self.unit[:2] <= _MAX_ERROR).all(dim=-1, keepdim=True) & (noise > 0)[..., None]
        if near_clean.device.type == "cpu" and not near_clean.any():
            return None
        with torch.autocast(output.device.type, enabled=False):  # as in Contacts
            wide = self.final.weight.dtype
            tokens, condition, output = tokens.to(wide), condition.to(wide), output.to(wide)
            with torch.no_grad():
                offset, scale = scene.estimate
                pose = torch.where((noise == 0)[..., None], scene.position, offset + scale * output)
                turn, shift = self.rotations.to(pose)
                rotation = nearest_rotations((pose[..., 3:] * turn + shift).unflatten(-1, (3, 3))).to(pose)
                centre, half = F.embedding(scene.states, self.boxes).split(3, dim=-1)
                metres = pose[..., :3] * self.unit + (rotation @ centre[..., None])[..., 0]
            biases, pairs = self.near(pose[..., :3], noise)
            extents = half, self.roundness(scene.states)[..., 0].sigmoid()
            messages, moves = self.touching(
                metres, rotation, scene.states, noise[..., None] * self.unit, pairs, scene.slot_mask, extents
            )
            bias = biases[0]
            if scene.slot_mask is not None:
                bias = bias.masked_fill(~scene.slot_mask[:, None, None], -torch.inf)
            tokens = self.block(tokens + messages + self.output_in(output.detach()), condition, bias, pairs)
            shift, size = self.final_modulation(condition).unsqueeze(1).chunk(2, dim=-1)
            features = self.final((1 + size) * F.layer_norm(tokens, (tokens.shape[-1],), eps=1e-6) + shift)
            change = self.pose_out(features) + F.pad(gated_displacement(moves, self.touching.gates(features)), (0, 9))
            return change.masked_fill(~near_clean, 0.0)
