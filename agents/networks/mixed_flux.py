"""The Flux-style transformer of the paper on mixed scenes: poses and categories in, pose output and logits out.

Text tokens, when there are any, meet the slots in double-stream blocks, which have weights of their own for each
stream, and join them in single-stream blocks (Flux; Esser et al. 2024; Pfaff et al., CoRL 2025, appendix).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.contacts import CHANNELS, Contacts, gated_displacement
from agents.networks.count_conditioning import CountConditioning
from agents.networks.count_embedding import CountEmbedding
from agents.networks.flux import timestep_embedding
from agents.networks.flux_blocks import DoubleStreamBlock, SingleStreamBlock
from agents.networks.mixed_flux_config import POSE, MixedFluxConfig
from agents.networks.relations import FEATURES, Relations
from agents.networks.rotation_features import ROTATION_FEATURES, gated_rotation, nearest_rotations, rotation_features
from scene_envs.errors import InvalidInputError

_TIME_WIDTH = 256


class MixedFlux(nn.Module):
    """Poses (B, N, 12) and category states (B, N) to a pose output (B, N, 12) and logits (B, N, K).

    Permutation-equivariant in the slots. Padding of the text is masked, so it changes nothing.

    >>> network = MixedFlux(MixedFluxConfig(categories=8, hidden=32, heads=2, text_width=16, frequencies=0))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedFluxConfig) -> None:
        super().__init__()
        self.config = config
        hidden, width = config.hidden, config.embedding
        self.pose_in = nn.Sequential(
            nn.Linear(POSE + 6 * config.frequencies + ROTATION_FEATURES * config.rotation_features, width),
            nn.SiLU(),
            nn.Linear(width, width),
        )
        self.category_in = nn.Embedding(config.categories + 1, width)
        self.given_in = nn.Embedding(4, width) if config.flags else None
        if self.given_in is not None:
            nn.init.zeros_(self.given_in.weight)
        self.scene_in = nn.Linear(width, hidden)
        self.time_in = nn.Sequential(nn.Linear(_TIME_WIDTH, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.text_in = nn.Linear(config.text_width, hidden) if config.text_width else None
        pooled = config.text_width and config.pooled_text
        self.pooled_in = nn.Linear(config.text_width, hidden, bias=False) if pooled else None
        text_width = config.text_width
        self.count_embedding = CountEmbedding(config.categories, text_width, hidden) if config.count_embedding else None
        most = config.count_conditioning if text_width else 0
        self.count_conditioning = CountConditioning(config.kinds, text_width, hidden, most) if most else None
        doubles = config.double_blocks if config.text_width else 0
        features = FEATURES if config.attention == "relative" else 0
        self.double_blocks = nn.ModuleList(
            DoubleStreamBlock(
                hidden, config.heads, config.mlp_ratio, features, config.text_reach == "double" and last == doubles
            )
            for last in range(1, doubles + 1)
        )
        self.single_blocks = nn.ModuleList(
            SingleStreamBlock(hidden, config.heads, config.mlp_ratio, features) for _ in range(config.single_blocks)
        )
        blocks = doubles + config.single_blocks
        self.relations = Relations(blocks, config.heads, config.unit, blur=config.relation_blur) if features else None
        self.final_modulation = nn.Linear(hidden, 2 * hidden)
        self.final = nn.Linear(hidden, width)
        self.pose_out = nn.Sequential(nn.Linear(width, config.pose_head), nn.SiLU(), nn.Linear(config.pose_head, POSE))
        self.logits_out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.categories))
        self.rotation_gates = nn.Linear(width, ROTATION_FEATURES) if config.rotation_features else None
        contacts = config.contacts and features
        self.contacts = Contacts(config.categories, features, hidden) if contacts else None
        self.contact_gates = nn.Linear(width, 3 * CHANNELS) if contacts else None
        gates = [layer for layer in (self.rotation_gates, self.contact_gates) if layer is not None]
        for layer in (self.final_modulation, self.pose_out[-1], self.logits_out[-1], *gates):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)
        self.octaves: Tensor
        self.rotations: Tensor
        octaves = math.pi * 2.0 ** torch.arange(config.frequencies, dtype=torch.float32)
        self.register_buffer("octaves", octaves, persistent=False)
        self.register_buffer("rotations", torch.tensor(config.rotations), persistent=False)

    def forward(
        self,
        pose: Tensor,
        states: Tensor,
        time: Tensor,
        *,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
        position: Tensor | None = None,
        noise_level: Tensor | None = None,
        given: Tensor | None = None,
        slot_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Predict.

        Args:
            pose: (B, N, 12) noisy poses, as the process scales them.
            states: (B, N) int64 in 0..K, K being the mask token.
            time: (B,) what is embedded, times ``time_scale``: a timestep or a log noise level.
            text: (B, L, W) text tokens; None for no text. With ``count_conditioning`` the first are of the kinds of
                objects.
            text_mask: (B, L) bool, True for real tokens.
            position: (B, N, 12) poses in signal units, for the features that are made of them; translations alone,
                (B, N, 3), will do without ``rotation_features`` and ``contacts``.
            noise_level: (B, N) noise-to-signal ratio of ``position``.
            given: (B, N) int64, 1 where the pose is given, plus 2 where the category is; None for nowhere.
            slot_mask: (B, N) bool, False for filling that nothing may attend to; None where there is none.

        Returns:
            pose output (B, N, 12) and logits (B, N, K) of the clean category.
        """
        asked = None
        if self.count_conditioning is not None and text is not None:
            asked, text = text[:, : self.count_conditioning.things], text[:, self.count_conditioning.things :]
            text_mask = None if text_mask is None else text_mask[:, self.count_conditioning.things :]
        condition = self.time_in(_embed(time * self.config.time_scale, pose.dtype))
        pooled = None if text is None else _mean_token(text, text_mask)
        if self.pooled_in is not None and pooled is not None:
            condition = condition + self.pooled_in(pooled)
        if self.count_embedding is not None:
            condition = condition + self.count_embedding(states, pooled, slot_mask)
        geometry = self._geometry(position, noise_level)
        turns = self._turns(geometry)
        features = self.pose_in(self._pose_features(pose, geometry, turns)) + self.category_in(states)
        if self.given_in is not None and given is not None:
            features = features + self.given_in(given)
        scene = self.scene_in(features)
        words = self._words(text, pose)
        count = 0 if words is None else words.shape[1]
        mask = _where_to_attend(text_mask, slot_mask, count, pose)
        biases, relations = self._related(geometry)
        messages, moves = self._touching(geometry, states, relations, slot_mask)
        scene = scene if messages is None else scene + messages
        if words is not None:
            for block in self.double_blocks:
                scene, words = block(scene, words, condition, _add_bias(next(biases), mask, count), relations)
            if self.config.text_reach == "all":
                scene = torch.cat([words, scene], dim=1)
            else:
                mask, count = None if mask is None else mask[..., count:], 0
        for block in self.single_blocks:
            scene = block(scene, condition, _add_bias(next(biases), mask, count), relations)
        scene = scene[:, count:]
        shift, scale = self.final_modulation(F.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        features = self.final((1 + scale) * F.layer_norm(scene, (self.config.hidden,), eps=1e-6) + shift)
        logits = self.logits_out(features)
        if self.count_conditioning is not None and asked is not None:
            logits = logits + self.count_conditioning(states, asked, slot_mask)[:, None]
        output = self.pose_out(features)
        if self.rotation_gates is not None and turns is not None:
            output = output + F.pad(gated_rotation(turns, self.rotation_gates(features)), (3, 0))
        if self.contact_gates is not None and moves is not None:
            output = output + F.pad(gated_displacement(moves, self.contact_gates(features)), (0, 9))
        return output, logits

    def _words(self, text: Tensor | None, pose: Tensor) -> Tensor | None:
        if self.text_in is None:
            return None
        result: Tensor = self.text_in(pose.new_zeros(len(pose), 1, self.config.text_width) if text is None else text)
        return result

    def _geometry(self, position: Tensor | None, noise_level: Tensor | None) -> _Geometry | None:
        config = self.config
        turned = self.rotation_gates is not None or self.contacts is not None
        if not (turned or config.frequencies or self.relations is not None):
            return None
        if position is None or noise_level is None:
            raise InvalidInputError(
                "a network with Fourier features, attention='relative', features of rotations or contacts needs "
                "position= and noise_level="
            )
        if not turned:
            return _Geometry(position, noise_level)
        scale, offset = self.rotations.to(position)
        noisy = (position[..., 3:POSE] * scale + offset).unflatten(-1, (3, 3))
        return _Geometry(position, noise_level, noisy, nearest_rotations(noisy))

    def _related(self, geometry: _Geometry | None) -> tuple[Iterator[Tensor | None], Tensor | None]:
        """Biases (B, heads, N, N) of block after block, and features of pairs of slots; None where there are none."""
        if self.relations is None or geometry is None:
            return itertools.repeat(None), None
        bias, features = self.relations(geometry.position[..., :3], geometry.noise_level)
        return iter(bias), features

    def _touching(
        self, geometry: _Geometry | None, states: Tensor, relations: Tensor | None, slot_mask: Tensor | None
    ) -> tuple[Tensor | None, Tensor | None]:
        """What :class:`~agents.networks.contacts.Contacts` say; None twice where the network has none."""
        if self.contacts is None or self.relations is None or relations is None or geometry is None:
            return None, None
        unit = self.relations.unit.to(geometry.position)
        metres, noise = geometry.position[..., :3] * unit, geometry.noise_level.unsqueeze(-1) * unit
        rotation = geometry.nearest.to(metres)
        with torch.autocast(metres.device.type, enabled=False):  # half of a percent of a metre is too much
            messages, moves = self.contacts(metres, rotation, states, noise, relations, slot_mask)
        return messages, moves

    def _turns(self, geometry: _Geometry | None) -> Tensor | None:
        """Features of the rotations, (B, N, :data:`ROTATION_FEATURES`); None where the network has none."""
        if self.rotation_gates is None or geometry is None:
            return None
        level = geometry.noise_level * self.rotations[0].max().to(geometry.noise_level)
        return rotation_features(geometry.noisy, geometry.nearest, level)

    def _pose_features(self, pose: Tensor, geometry: _Geometry | None, turns: Tensor | None) -> Tensor:
        features = [pose]
        if self.config.frequencies and geometry is not None:
            angle = geometry.position[..., :3, None] * self.octaves  # (B, N, 3, F)
            squared = (self.octaves * geometry.noise_level[..., None]) ** 2
            damping = torch.exp(-0.5 * squared).unsqueeze(-2)  # (B, N, 1, F)
            features += [(angle.sin() * damping).flatten(-2), (angle.cos() * damping).flatten(-2)]
        return torch.cat(features if turns is None else [*features, turns.to(pose)], dim=-1)


class _Geometry(NamedTuple):
    """Noisy poses in signal units, (B, N, 12) or translations alone, and the noise on them, (B, N)."""

    position: Tensor
    noise_level: Tensor
    noisy: Tensor = torch.empty(0)
    """(B, N, 3, 3) rotation matrices with their noise, where rotations are read."""
    nearest: Tensor = torch.empty(0)
    """(B, N, 3, 3) the rotations nearest to them."""


def _mean_token(text: Tensor, mask: Tensor | None) -> Tensor:
    """(B, W) mean of the real ones of tokens (B, L, W)."""
    if mask is None:
        return text.mean(dim=1)
    real = mask[..., None].to(text)
    return (text * real).sum(dim=1) / real.sum(dim=1).clamp(min=1.0)


def _where_to_attend(text_mask: Tensor | None, slot_mask: Tensor | None, count: int, pose: Tensor) -> Tensor | None:
    """(B, 1, 1, L + N) bool of ``count`` = L text tokens before N slots; None where nothing is masked."""
    if text_mask is None and slot_mask is None:
        return None
    everywhere = torch.ones(len(pose), count + pose.shape[1], dtype=torch.bool, device=pose.device)
    words = everywhere[:, :count] if text_mask is None or not count else text_mask
    slots = everywhere[:, count:] if slot_mask is None else slot_mask
    return torch.cat([words, slots], dim=1)[:, None, None]


def _add_bias(bias: Tensor | None, mask: Tensor | None, count: int) -> Tensor | None:
    """What is added to attention logits: ``bias`` on the slots, which follow ``count`` tokens, and the mask."""
    if bias is None:
        return mask
    bias = F.pad(bias, (count, 0, count, 0))
    return bias if mask is None else bias.masked_fill(~mask, -torch.inf)


def _embed(time: Tensor, dtype: torch.dtype) -> Tensor:
    """(B, 256) sinusoidal embedding of (B,) values, cosines first."""
    return timestep_embedding(time, _TIME_WIDTH).to(dtype)
