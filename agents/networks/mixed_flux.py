"""The Flux-style transformer of the paper on mixed scenes: poses and categories in, pose output and logits out.

Text tokens, when there are any, and slots attend to each other: first in double-stream blocks, which have weights of
their own for each stream, then as one stream in single-stream blocks (Flux; Esser et al. 2024; Pfaff et al., CoRL 2025,
appendix). Each part that is not in the paper is a module (:mod:`agents.networks.flux_modules`) that the configuration
lists.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux import timestep_embedding
from agents.networks.flux_blocks import DoubleStreamBlock, SingleStreamBlock
from agents.networks.flux_modules import FluxModule, Place, Scene
from agents.networks.mixed_flux_config import MixedFluxConfig
from agents.networks.rotation_features import nearest_rotations
from scene_envs.errors import InvalidInputError
from scene_envs.scene import POSE_FEATURES

_TIME_WIDTH = 256


class MixedFlux(nn.Module):
    """Poses (B, N, 12) and category states (B, N) to a pose output (B, N, 12) and logits (B, N, K).

    Permutation-equivariant in the slots. Padding of the text is masked, so it changes nothing.

    >>> network = MixedFlux(MixedFluxConfig(categories=8, hidden=32, heads=2, text_width=16))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedFluxConfig) -> None:
        super().__init__()
        self.config = config
        hidden, width = config.hidden, config.embedding
        read = POSE_FEATURES + sum(module.pose_width for module in config.modules)
        self.pose_in = nn.Sequential(nn.Linear(read, width), nn.SiLU(), nn.Linear(width, width))
        self.category_in = nn.Embedding(config.categories + 1, width)
        self._build_modules("slots")
        self.scene_in = nn.Linear(width, hidden)
        self.time_in = nn.Sequential(nn.Linear(_TIME_WIDTH, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.text_in = nn.Linear(config.text_width, hidden) if config.text_width else None
        self._build_modules("condition")
        doubles, pairs = config.blocks - config.single_blocks, config.pair_width
        self.double_blocks = nn.ModuleList(
            DoubleStreamBlock(
                hidden, config.heads, config.mlp_ratio, pairs, config.text_reach == "double" and last == doubles
            )
            for last in range(1, doubles + 1)
        )
        self.single_blocks = nn.ModuleList(
            SingleStreamBlock(hidden, config.heads, config.mlp_ratio, pairs) for _ in range(config.single_blocks)
        )
        self._build_modules("attention")
        self.final_modulation = nn.Linear(hidden, 2 * hidden)
        self.final = nn.Linear(hidden, width)
        self.pose_out = nn.Sequential(
            nn.Linear(width, config.pose_head), nn.SiLU(), nn.Linear(config.pose_head, POSE_FEATURES)
        )
        self.logits_out = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.categories))
        self._build_modules("output")
        for layer in (self.final_modulation, self.pose_out[-1], self.logits_out[-1]):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)
        self.unit: Tensor
        self.rotations: Tensor
        self.register_buffer("unit", torch.tensor(config.unit), persistent=False)
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
        observed: Tensor | None = None,
        slot_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Predict.

        Args:
            pose: (B, N, 12) noisy poses, as the process scales them.
            states: (B, N) int64 in 0..K, K being the mask token.
            time: (B,) a timestep or a log noise level; it is multiplied by ``time_scale`` and embedded.
            text: (B, L, W) text tokens; None for no text. The first tokens are read by single modules only.
            text_mask: (B, L) bool, True for real tokens.
            position: (B, N, 12) poses in signal units, for modules that read geometry; translations alone, (B, N, 3),
                are enough where no module reads rotations.
            noise_level: (B, N) noise-to-signal ratio of ``position``.
            observed: (B, N) int64, 1 where the pose is observed, plus 2 where the category is; None if nothing is
                observed.
            slot_mask: (B, N) bool, False for padding slots, to which nothing may attend; None where there are none.

        Returns:
            pose output (B, N, 12) and logits (B, N, K) of the clean category.
        """
        scene = Scene(states, observed, slot_mask)
        text, text_mask = self._take_text(scene, text, text_mask)
        self._read_geometry(scene, position, noise_level)
        embedded = timestep_embedding(time * self.config.time_scale, _TIME_WIDTH).to(pose.dtype)
        condition = self._add(self.time_in(embedded), lambda module: module.condition(scene))
        read = [module.pose_features(scene) for module in self._added()]
        features = self.pose_in(torch.cat([pose, *(part.to(pose) for part in read if part is not None)], dim=-1))
        slots = self._add(features + self.category_in(states), lambda module: module.slot_features(scene))
        tokens = self.scene_in(slots)
        biases = self._relate(scene)
        tokens = self._add(tokens, lambda module: module.messages(scene))
        tokens = self._attend(tokens, self._words(text, pose), condition, text_mask, biases, scene)
        shift, scale = self.final_modulation(F.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        features = self.final((1 + scale) * F.layer_norm(tokens, (self.config.hidden,), eps=1e-6) + shift)
        logits = self._add(self.logits_out(features), lambda module: module.logits(scene))
        return self._add(self.pose_out(features), lambda module: module.pose_output(scene, features)), logits

    def groups_by_number(self, text: Tensor) -> Tensor | None:
        """(B, K) int64 groups of categories by the numbers that ``text`` (B, L, W) gives; None without such a module.

        See :meth:`~agents.networks.count_conditioning.CountConditioning.groups_by_number`.
        """
        for module in self.config.modules:
            count = module.text_tokens(self.config)
            groups = getattr(self, module.name).groups_by_number(text[:, :count]) if count else None
            if groups is not None:
                return groups
            text = text[:, count:]
        return None

    # -- blocks -----------------------------------------------------------------------------------

    def _attend(
        self,
        slots: Tensor,
        words: Tensor | None,
        condition: Tensor,
        text_mask: Tensor | None,
        biases: Iterator[Tensor | None],
        scene: Scene,
    ) -> Tensor:
        """Slots (B, N, H) and words (B, L, H) through all blocks to slots (B, N, H)."""
        count = 0 if words is None else words.shape[1]
        mask = _where_to_attend(text_mask, scene.slot_mask, count, slots)
        if words is not None:
            for block in self.double_blocks:
                slots, words = block(slots, words, condition, _add_bias(next(biases), mask, count), scene.pairs)
            if self.config.text_reach == "all":
                slots = torch.cat([words, slots], dim=1)
            else:
                mask, count = None if mask is None else mask[..., count:], 0
        for block in self.single_blocks:
            slots = block(slots, condition, _add_bias(next(biases), mask, count), scene.pairs)
        return slots[:, count:]

    def _words(self, text: Tensor | None, pose: Tensor) -> Tensor | None:
        if self.text_in is None:
            return None
        return self.text_in(pose.new_zeros(len(pose), 1, self.config.text_width) if text is None else text)

    # -- modules ----------------------------------------------------------------------------------

    def _build_modules(self, place: Place) -> None:
        """Add the modules of this ``place``, with fresh weights."""
        for module in self.config.modules:
            if module.place == place:
                self.add_module(module.name, module.build(self.config))

    def _added(self) -> Iterator[FluxModule]:
        return (getattr(self, module.name) for module in self.config.modules)

    def _add(self, value: Tensor, hook: Callable[[FluxModule], Tensor | None]) -> Tensor:
        """``value`` plus what a hook of every module returns."""
        for module in self._added():
            part = hook(module)
            value = value if part is None else value + part
        return value

    def _take_text(self, scene: Scene, text: Tensor | None, mask: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """The tokens that are not for single modules, with their mask.

        Puts the leading tokens of modules, and the mean of the other tokens, into ``scene``.
        """
        if text is None:
            return None, mask
        for module in self.config.modules:
            count = module.text_tokens(self.config)
            if count:
                scene.own_text[module.name], text = text[:, :count], text[:, count:]
                mask = None if mask is None else mask[:, count:]
        scene.summary = _mean_token(text, mask)
        return text, mask

    def _read_geometry(self, scene: Scene, position: Tensor | None, noise_level: Tensor | None) -> None:
        """Put translations in metres, rotations, and the noise on them into ``scene``, where modules read them.

        Raises:
            InvalidInputError: a module reads geometry, and none is given.
        """
        readers = [module.name for module in self.config.modules if module.reads_geometry]
        if not readers:
            return
        if position is None or noise_level is None:
            raise InvalidInputError(f"a network with {', '.join(readers)} needs position= and noise_level=")
        unit = self.unit.to(position)
        scene.position, scene.noise_level = position, noise_level
        scene.metres, scene.metres_noise = position[..., :3] * unit, noise_level.unsqueeze(-1) * unit
        if any(module.reads_rotations for module in self.config.modules):
            scale, offset = self.rotations.to(position)
            scene.noisy_rotation = (position[..., 3:POSE_FEATURES] * scale + offset).unflatten(-1, (3, 3))
            scene.rotation = nearest_rotations(scene.noisy_rotation)
            scene.rotation_noise = noise_level * self.rotations[0].max().to(noise_level)

    def _relate(self, scene: Scene) -> Iterator[Tensor | None]:
        """Iterator over the biases (B, heads, N, N) of the blocks; puts features of pairs into ``scene``."""
        parts = [part for module in self._added() if (part := module.relations(scene)) is not None]
        if not parts:
            return itertools.repeat(None)
        biases, features = zip(*parts, strict=True)
        scene.pairs = features[0] if len(features) == 1 else torch.cat(features, dim=-1)
        return iter(biases[0] if len(biases) == 1 else torch.stack(biases).sum(dim=0))


def _mean_token(text: Tensor, mask: Tensor | None) -> Tensor:
    """(B, W) mean of the tokens (B, L, W) that are not padding."""
    if mask is None:
        return text.mean(dim=1)
    real = mask[..., None].to(text)
    return (text * real).sum(dim=1) / real.sum(dim=1).clamp(min=1.0)


def _where_to_attend(text_mask: Tensor | None, slot_mask: Tensor | None, count: int, slots: Tensor) -> Tensor | None:
    """(B, 1, 1, L + N) bool over ``count`` = L text tokens, then N slots; None where nothing is masked."""
    if text_mask is None and slot_mask is None:
        return None
    everywhere = torch.ones(len(slots), count + slots.shape[1], dtype=torch.bool, device=slots.device)
    words = everywhere[:, :count] if text_mask is None or not count else text_mask
    present = everywhere[:, count:] if slot_mask is None else slot_mask
    return torch.cat([words, present], dim=1)[:, None, None]


def _add_bias(bias: Tensor | None, mask: Tensor | None, count: int) -> Tensor | None:
    """Sum of attention biases: ``bias`` on the slots, which follow ``count`` tokens, and the mask."""
    if bias is None:
        return mask
    bias = F.pad(bias, (count, 0, count, 0)) if count else bias
    return bias if mask is None else bias.masked_fill(~mask, -torch.inf)
