"""Pairwise contacts: distances at which two objects touch, and displacements along the gaps between them.

Objects do not overlap, and stand on each other, to within a fraction of a millimetre. The distance between the centres
of two touching objects depends on both categories and on the direction, and on hardly anything else. A transformer that
reads positions has to learn this distance by itself, for every pair of categories. Here a small network on pairs of
slots learns the distance. The gap is the actual distance minus the learned one, in units of the noise, because a
denoiser can move objects only on the scale of the noise. Messages and displacements are computed from the gaps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene

CHANNELS = 4
"""Number of displacements of every slot."""
_GAPS = 8  # of a pair: horizontal, in height, along the three axes of i, along those of j
_DIRECTIONS = 6
_BASIS = 3  # functions of each gap that a layer reads
_REACH = 4.0
_GAP_OF = (0, 0, 1, 2, 3, 4, 5, 5, 5, 6, 6, 6, 7, 7, 7)
"""The gap of each component of ``ways``: x, y, z of the world, the axes of i, and x, y, z of each axis of j."""
_TYPICAL = 0.1  # metres between the centres of objects that touch
_LEAST_NOISE = 2e-4  # metres


@dataclass(frozen=True)
class ContactsConfig(ModuleConfig):
    """Displacements along the gaps between objects; reads the features of pairs that relations offer."""

    name = "contacts"
    place = "output"
    requires = ("relations",)
    reads_geometry = True
    reads_rotations = True

    def build(self, core: FluxSizes) -> Contacts:
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
        features: numbers per pair of slots, from :class:`~agents.networks.relations.Relations`.
        hidden: width of the messages.
        embedding: width of the features from which the gates of the displacements are computed.
        width: of the networks on pairs.
        kind: width of the embedding of a category.

    >>> contacts = Contacts(categories=3, features=40, hidden=16, embedding=16)
    >>> metres, rotation = torch.randn(2, 5, 3), torch.eye(3).expand(2, 5, 3, 3)
    >>> states, noise, features = torch.zeros(2, 5).long(), torch.full((2, 5, 3), 0.1), torch.zeros(2, 5, 5, 40)
    >>> messages, displacements = contacts(metres, rotation, states, noise, features)
    >>> messages.shape, displacements.shape
    (torch.Size([2, 5, 16]), torch.Size([2, 5, 4, 3]))
    """

    def __init__(
        self, categories: int, features: int, hidden: int, embedding: int, width: int = 32, kind: int = 16
    ) -> None:
        super().__init__()
        self.kind = nn.Embedding(categories + 1, kind)
        self.seen = nn.Linear(features + 2 * _DIRECTIONS, width)
        self.own, self.other = (nn.Linear(kind, 2 * width, bias=False) for _ in range(2))
        self.touch = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, _GAPS))
        self.weigh = nn.Linear(width + _BASIS * _GAPS + 1, width)
        self.second = nn.Linear(width, width)
        self.amplitudes = nn.Linear(width, CHANNELS * 2 * _GAPS)
        self.out = nn.Linear(width, hidden)
        self.gates = nn.Linear(embedding, 3 * CHANNELS)
        for layer in (self.out, self.gates):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

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
        self,
        metres: Tensor,
        rotation: Tensor,
        states: Tensor,
        noise: Tensor,
        features: Tensor,
        slot_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Messages (B, N, H) to slots, and displacements (B, N, :data:`CHANNELS`, 3) in units of the noise.

        Args:
            metres: (B, N, 3) noisy positions.
            rotation: (B, N, 3, 3) rotation matrices, such as the nearest to noisy matrices; their columns must be unit
                vectors.
            states: (B, N) int64 categories, mask tokens among them.
            noise: (B, N, 3) standard deviation of the noise on positions along x, y, z, metres.
            features: (B, N, N, F) of pairs of slots.
            slot_mask: (B, N) bool, False for padding slots, which nothing may see; None where there are none.
        """
        offset = metres.unsqueeze(2) - metres.unsqueeze(1)  # (B, N, N, 3) from j to i
        variance = noise.square().unsqueeze(2) + noise.square().unsqueeze(1) + _LEAST_NOISE**2
        sideways = offset[..., :2].square().sum(dim=-1, keepdim=True).add(1e-12).sqrt()
        toward = offset[..., :2] / sideways
        own = offset @ rotation  # the axes of i
        others = torch.einsum("bijw,bjwk->bijk", offset, rotation)
        along = torch.cat([sideways, offset[..., 2:], own, others], dim=-1)  # (B, N, N, GAPS)
        level = (toward.square() * variance[..., :2]).sum(dim=-1, keepdim=True)
        squared = rotation.square()
        spread = [level, variance[..., 2:], variance @ squared, torch.einsum("bijw,bjwk->bijk", variance, squared)]
        both = torch.cat(spread, dim=-1).clamp(min=_LEAST_NOISE**2).sqrt()  # (B, N, N, GAPS) noise along each
        sign = along / (along.square() + both.square()).sqrt()
        aside = toward * sign[..., :1]
        kinds = self.kind(states)
        early, late = (self.own(kinds).unsqueeze(2) + self.other(kinds).unsqueeze(1)).chunk(2, dim=-1)
        seen = F.silu(self.seen(torch.cat([features, *_as_seen(aside, rotation)], dim=-1)) + early)
        gaps = (along.abs() - _TYPICAL * (1.0 + self.touch(seen))) / both
        bounded = gaps / (1.0 + (gaps / _REACH).square()).sqrt()
        basis = [bounded, torch.sigmoid(-2.0 * gaps), torch.exp(-0.5 * gaps.square()), both[..., :1].log()]
        weighed = F.silu(self.weigh(torch.cat([seen, *basis], dim=-1)) + late)
        weighed = F.silu(self.second(weighed))
        there = (~torch.eye(states.shape[1], dtype=torch.bool, device=states.device))[None].to(weighed)
        there = (there if slot_mask is None else there * slot_mask.unsqueeze(1)).unsqueeze(-1)
        weighed = torch.cat([weighed * there, there.expand(*weighed.shape[:-1], 1)], dim=-1)  # (B, N, N, W + 1)
        sign = sign / both
        ways = [aside / both[..., :1], sign[..., 1:5], (sign[..., 5:, None] * rotation.mT.unsqueeze(1)).flatten(-2)]
        moves = self._displacements(weighed, torch.cat(ways, dim=-1), bounded, rotation)
        moves = math.sqrt(2) * noise.unsqueeze(-2) * moves
        known = (states < self.kind.num_embeddings - 1).unsqueeze(-1)
        return self.out(weighed[..., :-1].sum(dim=2)) * known, moves

    def _displacements(self, weighed: Tensor, ways: Tensor, bounded: Tensor, rotation: Tensor) -> Tensor:
        """Displacements (B, N, CHANNELS, 3): per gap one amplitude plus another times the gap, summed over other slots.

        Amplitudes are linear in ``weighed`` (B, N, N, W + 1), so the sum over other slots is taken first. Then the cost
        per pair does not grow with CHANNELS.
        """
        ways = torch.cat([ways, ways * bounded[..., _GAP_OF]], dim=-1)
        gathered = weighed.mT @ ways  # (B, N, W + 1, 2 * 15)
        amplitudes = torch.cat([self.amplitudes.weight, self.amplitudes.bias[:, None]], dim=1)
        amplitudes = amplitudes.unflatten(0, (2, CHANNELS, _GAPS))[:, :, _GAP_OF]  # (2, CHANNELS, 15, W + 1)
        moves = torch.einsum("biusq,scqu->bicq", gathered.unflatten(-1, (2, -1)), amplitudes)
        level, own, others = moves.split([3, 3, 9], dim=-1)
        return level + own @ rotation.mT + others.unflatten(-1, (3, 3)).sum(dim=-2)


def gated_displacement(displacements: Tensor, gates: Tensor) -> Tensor:
    """Contribution (B, N, 3) of displacements (B, N, :data:`CHANNELS`, 3) to the translation output.

    Args:
        displacements: as :class:`Contacts` returns them.
        gates: (B, N, CHANNELS * 3), one for each entry of the displacements.
    """
    return (displacements * gates.unflatten(-1, (CHANNELS, 3))).sum(dim=-2)


def _as_seen(aside: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal directions in the frames of i and of j, with their squares, (B, N, N, 6) each.

    The first is from j to i in the frame of i, the second from i to j in the frame of j; ``aside`` (B, N, N, 2) is from
    j to i in the world.
    """
    first = aside @ rotation[..., :2, :]
    second = -torch.einsum("bijw,bjwk->bijk", aside, rotation[..., :2, :])
    return torch.cat([first, first.square()], dim=-1), torch.cat([second, second.square()], dim=-1)
