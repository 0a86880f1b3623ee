"""Flux-style transformers over the slots of a scene, without positional encoding (Flux; Esser et al. 2024).

The continuous network reads scenes as numbers. The mixed one is that of the paper (Pfaff et al., CoRL 2025, appendix):
poses and categories in, pose output and logits out. Text tokens, when there are any, and slots attend to each other:
first in double-stream blocks, which have weights of their own for each stream, then as one stream in single-stream
blocks. Each part that is not in the paper is a module (:mod:`agents.networks.flux_modules`) that the configuration
lists.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.denoisers import products_in
from agents.networks.flux_modules import (
    CountConditioningConfig,
    CountEmbeddingConfig,
    CountLogitsConfig,
    FluxModule,
    FourierFeatures,
    FourierFeaturesConfig,
    ModuleConfig,
    ObservedFlagsConfig,
    Place,
    PooledTextConfig,
    Scene,
    start_at_zero,
)
from agents.networks.geometry import (
    ContactsConfig,
    RefinementConfig,
    RelationsConfig,
    RotationFeaturesConfig,
    joint_attention,
    nearest_rotations,
)
from agents.networks.registry import register_network
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import POSE_FEATURES


class _Gelu(torch.autograd.Function):
    """GELU with tanh, written out: on a CPU this takes half of the time of the function of torch."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        if ctx is not None:
            ctx.save_for_backward(x)
        inner = x * x
        torch.addcmul(x, inner, x, value=0.044715, out=inner).mul_(math.sqrt(2.0 / math.pi)).tanh_()
        return torch.addcmul(x, x, inner, out=inner).mul_(0.5)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return torch.ops.aten.gelu_backward(gradients[0], *ctx.saved_tensors, approximate="tanh")  # type: ignore[no-any-return]


def gelu(x: Tensor) -> Tensor:
    """GELU in its form with tanh (Hendrycks and Gimpel 2016)."""
    if x.device.type != "cpu" or torch.compiler.is_compiling():
        return F.gelu(x, approximate="tanh")
    return _Gelu.apply(x) if torch.is_grad_enabled() else _Gelu.forward(None, x)  # type: ignore[no-any-return, no-untyped-call]


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
        start_at_zero(self.modulation)

    def forward(
        self, tokens: Tensor, condition: Tensor, mask: Tensor | None = None, relations: Tensor | None = None
    ) -> Tensor:
        """Tokens (B, T, H) and condition (B, H) to tokens (B, T, H).

        Args:
            tokens: (B, T, H).
            condition: (B, H), after its nonlinearity, which all blocks share.
            mask: (B, 1 or heads, 1 or T, T), bool, True where to attend, or float, added to the attention logits.
            relations: (B, N, N, F) features of pairs of the last N tokens; needs a float mask.
        """
        shift, scale, gate = self.modulation(condition).unsqueeze(1).chunk(3, dim=-1)
        x = ((1 + scale) * F.layer_norm(tokens, (self.hidden,), eps=1e-6)).add_(shift)
        qkv, mlp = self.linear1(x).split([3 * self.hidden, self.mlp_hidden], dim=-1)
        query, key, value = _heads(qkv, self.heads, self.query_norm, self.key_norm)
        attended = joint_attention(query, key, value, mask, relations, self.gathered)
        return torch.addcmul(tokens, gate, self.linear2(torch.cat([attended, gelu(mlp)], dim=-1)))


def _heads(qkv: Tensor, heads: int, query_norm: nn.RMSNorm, key_norm: nn.RMSNorm) -> tuple[Tensor, ...]:
    """Query, key and value (B, heads, T, W) of (B, T, 3 H), the first two normalised, both at once."""
    parts = qkv.unflatten(-1, (3, heads, -1)).permute(2, 0, 3, 1, 4).contiguous()
    scale = torch.stack([query_norm.weight, key_norm.weight]).view(2, 1, 1, 1, -1)
    query, key = F.rms_norm(parts[:2], parts.shape[-1:], None, 1e-6).mul(scale)
    return query, key, parts[2]


class DoubleStreamBlock(nn.Module):
    """Joint attention of two streams with their own projections, norms and MLPs, gated by the condition.

    Args:
        hidden, heads, mlp_ratio, relations: arguments of :class:`SingleStreamBlock`.
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
        """Slots (B, N, H) and text (B, L, H) to the same; the other arguments as in single-stream blocks.

        A text that ends asks nothing: ``mask`` then has a row for each slot alone.
        """
        scene, text = scene + self.scene.modality, text + self.text.modality
        rates = [stream.rates(condition) for stream in (self.text, self.scene)]
        words: Any = self.text.heads_of(text, rates[0])
        slots: Any = self.scene.heads_of(scene, rates[1])
        query = slots[0] if words[0] is None else torch.cat([words[0], slots[0]], dim=2)
        key, value = (torch.cat([words[part], slots[part]], dim=2) for part in (1, 2))
        attended = joint_attention(query, key, value, mask, relations, self.gathered)
        if words[0] is None:
            return self.scene.finish(scene, attended, rates[1]), text
        of_words, of_slots = attended.split([text.shape[1], scene.shape[1]], dim=1)
        return self.scene.finish(scene, of_slots, rates[1]), self.text.finish(text, of_words, rates[0])


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
        start_at_zero(self.modulation)

    def rates(self, condition: Tensor) -> tuple[Tensor, ...]:
        """Shift, scale and gate of the attention, then of the MLP, (B, 1, H) each; the first two where text ends."""
        return self.modulation(condition).unsqueeze(1).chunk(6 if self.finishes else 2, dim=-1)  # type: ignore[no-any-return]

    def heads_of(self, x: Tensor, rates: tuple[Tensor, ...]) -> tuple[Tensor | None, Tensor, Tensor]:
        """Query, key and value (B, heads, N, width); no query where text ends."""
        x = ((1 + rates[1]) * F.layer_norm(x, (self.hidden,), eps=1e-6)).add_(rates[0])
        if isinstance(self.query_norm, nn.RMSNorm):
            query, key, value = _heads(self.qkv(x), self.heads, self.query_norm, self.key_norm)
            return query, key, value
        both = F.linear(x, self.qkv.weight[self.hidden :], self.qkv.bias[self.hidden :])
        key, value = both.unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return None, self.key_norm(key), value

    def finish(self, x: Tensor, attended: Tensor, rates: tuple[Tensor, ...]) -> Tensor:
        """The tokens after the gated residuals of attention and MLP."""
        x = torch.addcmul(x, rates[2], self.out(attended))
        inner = ((1 + rates[4]) * F.layer_norm(x, (self.hidden,), eps=1e-6)).add_(rates[3])
        return torch.addcmul(x, rates[5], self.mlp[2](gelu(self.mlp[0](inner))))


@dataclass(frozen=True)
class FluxConfig:
    """Size of a :class:`FluxDenoiser`.

    Attributes:
        features: D, numbers per slot.
        hidden: width of the token stream; a multiple of ``heads``.
        depth: number of single-stream blocks.
        heads: attention heads.
        mlp_ratio: width of the MLP branch over ``hidden``.
        frequencies: octaves of Fourier features of each translation (0: none).
    """

    features: int
    hidden: int = 192
    depth: int = 6
    heads: int = 6
    mlp_ratio: float = 4.0
    frequencies: int = 8

    def __post_init__(self) -> None:
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")


def timestep_embedding(value: Tensor, width: int) -> Tensor:
    """Sinusoidal embedding (B, width) of ``value`` (B,), cosines first."""
    half = width // 2
    value = value if value.is_floating_point() else value.float()
    frequency = torch.exp(-math.log(10_000.0) * torch.arange(half, device=value.device, dtype=value.dtype) / half)
    angle = value[:, None] * frequency[None]
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


class FluxDenoiser(nn.Module):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D); permutation-equivariant in N.

    Translations enter twice: linearly, and as Fourier features damped by the noise level (the expected
    feature under the noise, as in mip-NeRF's integrated encoding). So attention can compare distances
    to a millimetre where the noise is small enough.

    >>> denoiser = FluxDenoiser(FluxConfig(features=20, hidden=32, depth=2, heads=2))
    >>> x = torch.randn(2, 34, 20)
    >>> denoiser(x, x, torch.tensor([0.1, 0.2])).shape
    torch.Size([2, 34, 20])
    """

    def __init__(self, config: FluxConfig) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden
        self.scene_in = nn.Linear(config.features + 6 * config.frequencies, hidden)
        self.time_in = nn.Sequential(nn.Linear(128, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.blocks = nn.ModuleList(
            SingleStreamBlock(hidden, config.heads, config.mlp_ratio) for _ in range(config.depth)
        )
        self.final_modulation = nn.Linear(hidden, 2 * hidden)
        self.out = nn.Linear(hidden, config.features)
        start_at_zero(self.final_modulation, self.out)
        self.fourier = FourierFeatures(config.frequencies)
        self.body_precision = "float32"

    def forward(self, x: Tensor, position: Tensor, noise_level: Tensor) -> Tensor:
        """Predict.

        Args:
            x: (B, N, D) network input, unit variance.
            position: (B, N, D) the scene in signal units, x_t / alpha_t; its first three features are read.
            noise_level: (B,) noise-to-signal ratio of ``position``.
        """
        features = torch.cat([x, self.fourier(position, noise_level[:, None])], dim=-1)
        condition = F.silu(self.time_in(timestep_embedding(250.0 * noise_level.log(), 128)))
        tokens = self.scene_in(features)
        with products_in(self.body_precision, tokens):
            for block in self.blocks:
                tokens = block(tokens, condition)
        tokens = tokens.to(features.dtype)
        shift, scale = self.final_modulation(condition).unsqueeze(1).chunk(2, dim=-1)
        return self.out((1 + scale) * F.layer_norm(tokens, (self.config.hidden,), eps=1e-6) + shift)


# -- mixed scenes ---------------------------------------------------------------------------------


TEXT_REACHES = ("all", "double")
"""Blocks in which slots and text attend to each other."""
TIME_INPUTS = ("timestep", "log_noise")
"""Numbers that may be embedded as time: t - 1, or 250 times the logarithm of the noise-to-signal ratio."""
MODULES: dict[str, type[ModuleConfig]] = {
    kind.name: kind
    for kind in (
        ObservedFlagsConfig,
        PooledTextConfig,
        CountEmbeddingConfig,
        CountConditioningConfig,
        RelationsConfig,
        FourierFeaturesConfig,
        RotationFeaturesConfig,
        ContactsConfig,
        RefinementConfig,
        CountLogitsConfig,
    )
}
"""The configurations of all modules by name; a new module is one more entry."""


@dataclass(frozen=True)
class MixedFluxConfig:
    """Size of a :class:`~agents.networks.MixedFlux`, what it reads, and the modules that are added to its core.

    Attributes:
        categories: K = C + 1, assets and *empty*; the mask token is one more.
        hidden: H, width of the token streams; a multiple of ``heads``.
        double_blocks: blocks in which text and slots have weights of their own; used only with text.
        single_blocks: blocks on text and slots together.
        heads: attention heads.
        mlp_ratio: width of the MLPs over ``hidden``.
        embedding: E, width of the embedding of a slot, and of what leaves the last layer.
        pose_head: hidden width of the pose output.
        text_width: W, width of the text tokens; 0 for none.
        text_reach: blocks that read text: the ``"double"``-stream ones, or ``"all"``, as the paper's.
        time_input: number that is embedded as time, one of :data:`TIME_INPUTS`; ``"timestep"`` is the paper's.
        time_scale: factor on the time before it is embedded.
        unit: metres per normalised unit along x, y, z, for modules that read geometry.
        rotations: what the nine normalised numbers of a rotation are multiplied by, and what is then added, to be that
            of an object, for modules that read rotations.
        modules: what is added to the core, in the order in which it is applied; the paper has none. Mappings
            ``{"name": …, **fields}`` become configurations.

    >>> config = MixedFluxConfig(8, modules=(RelationsConfig(blur="axis"), ContactsConfig()))
    >>> config.without("contacts").modules
    (RelationsConfig(blur='axis'),)
    """

    categories: int
    hidden: int = 128
    double_blocks: int = 2
    single_blocks: int = 4
    heads: int = 4
    mlp_ratio: float = 4.0
    embedding: int = 128
    pose_head: int = 64
    text_width: int = 0
    text_reach: str = "all"
    time_input: str = "timestep"
    time_scale: float = 1.0
    unit: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rotations: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,) * 9, (0.0,) * 9)
    modules: tuple[ModuleConfig, ...] = ()

    reads_slot_mask: ClassVar[bool] = True
    """Whether the network takes ``slot_mask``, the slots that it ignores."""

    def __post_init__(self) -> None:
        if self.text_reach not in TEXT_REACHES:
            raise unknown_name("reach of text", self.text_reach, TEXT_REACHES)
        if self.time_input not in TIME_INPUTS:
            raise unknown_name("time input", self.time_input, TIME_INPUTS)
        object.__setattr__(self, "unit", tuple(self.unit))  # lists, when they come from JSON
        object.__setattr__(self, "rotations", tuple(tuple(numbers) for numbers in self.rotations))
        object.__setattr__(self, "modules", tuple(make_module(entry) for entry in self.modules))
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")
        before: list[str] = []
        for module in self.modules:
            lacking = [name for name in module.requires if name not in before]
            if lacking:
                raise InvalidInputError(f"the module {module.name!r} needs {', '.join(lacking)} before it in modules")
            if module.reads_text and not self.text_width:
                raise InvalidInputError(f"the module {module.name!r} needs a network with text, text_width above 0")
            if module.name in before:
                raise InvalidInputError(f"the module {module.name!r} is listed twice")
            before.append(module.name)

    @property
    def blocks(self) -> int:
        """Attention blocks, double-stream and single-stream."""
        return (self.double_blocks if self.text_width else 0) + self.single_blocks

    @property
    def pair_width(self) -> int:
        """Features of a pair of slots, of all modules."""
        return sum(module.pair_width for module in self.modules)

    @property
    def reads_estimate(self) -> bool:
        """Whether a module reads the denoised scene."""
        return any(module.reads_estimate for module in self.modules)

    def block(self, pairs: int) -> SingleStreamBlock:
        """A single-stream block with fresh weights, on ``pairs`` features of a pair of slots."""
        return SingleStreamBlock(self.hidden, self.heads, self.mlp_ratio, pairs)

    def state(self) -> dict[str, Any]:
        """The fields for a file, the names of the modules among theirs."""
        return {**asdict(self), "modules": [{"name": module.name, **vars(module)} for module in self.modules]}

    def without(self, *names: str) -> MixedFluxConfig:
        """The same network without some modules, which is an ablation.

        Raises:
            UnknownNameError: the network has no such module.
        """
        present = [module.name for module in self.modules]
        for name in names:
            if name not in present:
                raise unknown_name("module of the network", name, present)
        return replace(self, modules=tuple(module for module in self.modules if module.name not in names))


def make_module(entry: ModuleConfig | Mapping[str, Any]) -> ModuleConfig:
    """A module's configuration: ``entry`` itself, or made from ``{"name": …, **fields}``."""
    if isinstance(entry, ModuleConfig):
        return entry
    options = {key: value for key, value in entry.items() if key != "name"}
    name = entry.get("name", "")
    if name not in MODULES:
        raise unknown_name("module of the network", str(name), MODULES)
    strange = sorted(options.keys() - {field.name for field in fields(MODULES[name])})
    if strange:
        raise InvalidInputError(f"the module {name!r} has no fields {strange}")
    return MODULES[name](**options)


_TIME_WIDTH = 256


class MixedFlux(nn.Module):
    """Poses (B, N, 12) and category states (B, N) to a pose output (B, N, 12) and logits (B, N, K).

    Permutation-equivariant in the slots. Padding of the text is masked, so it changes nothing. The products of the
    blocks are in ``body_precision``, which denoisers set at every step of a chain.

    >>> network = MixedFlux(MixedFluxConfig(categories=8, hidden=32, heads=2, text_width=16))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedFluxConfig) -> None:
        super().__init__()
        self.left_out: frozenset[str] = frozenset()  # names of modules that calls leave out for now
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
        self.body_precision = "float32"
        start_at_zero(self.final_modulation, self.pose_out[-1], self.logits_out[-1])
        self.unit: Tensor
        self.rotations: Tensor
        self.register_buffer("unit", torch.tensor(config.unit), persistent=False)
        self.register_buffer("rotations", torch.tensor(config.rotations), persistent=False)

    def forward(
        self, pose: Tensor, states: Tensor, time: Tensor, *, text: Tensor | None = None,
        text_mask: Tensor | None = None, position: Tensor | None = None, noise_level: Tensor | None = None,
        observed: Tensor | None = None, slot_mask: Tensor | None = None, clean_offset: Tensor | None = None,
        clean_scale: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
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
            clean_offset, clean_scale: (B, N, 12) each, for modules that read the denoised scene: its poses in signal
                units are offset + scale * pose output. Without them these modules correct nothing.

        Returns:
            pose output (B, N, 12) and logits (B, N, K) of the clean category.
        """
        scene = Scene(states, observed, slot_mask)
        text, text_mask = self.take_text(scene, text, text_mask)
        self._read_geometry(scene, position, noise_level)
        embedded = timestep_embedding(time * self.config.time_scale, _TIME_WIDTH).to(pose.dtype)
        condition = F.silu(self._add(self.time_in(embedded), lambda module: module.condition(scene)))
        read = [module.pose_features(scene) for module in self._added()]
        features = self.pose_in(torch.cat([pose, *(part.to(pose) for part in read if part is not None)], dim=-1))
        slots = self._add(features + self.category_in(states), lambda module: module.slot_features(scene))
        tokens = self.scene_in(slots)
        biases = self._relate(scene)
        tokens = self._add(tokens, lambda module: module.messages(scene))
        text = pose.new_zeros(len(pose), 1, self.config.text_width) if text is None else text
        words = None if self.text_in is None else self.text_in(text)
        with products_in(self.body_precision, tokens):
            tokens = self._attend(tokens, words, condition, text_mask, biases, scene).to(tokens.dtype)
        shift, scale = self.final_modulation(condition).unsqueeze(1).chunk(2, dim=-1)
        features = self.final((1 + scale) * F.layer_norm(tokens, (self.config.hidden,), eps=1e-6) + shift)
        logits = self._add(self.logits_out(features), lambda module: module.logits(scene))
        output = self._add(self.pose_out(features), lambda module: module.pose_output(scene, features))
        if clean_offset is None or clean_scale is None:
            return output, logits
        scene.estimate = clean_offset, clean_scale
        return self._add(output, lambda module: module.correction(scene, tokens, condition, output)), logits

    def extended(self, added: ModuleConfig) -> MixedFlux:
        """This network with one more module; an InvalidInputError if it lacks one that this module requires."""
        with torch.random.fork_rng(devices=[]):  # the random state of the caller stays
            torch.manual_seed(0)  # the same start in every process
            network = MixedFlux(replace(self.config, modules=(*self.config.modules, added)))
        network = network.to(next(self.parameters()))
        network.load_state_dict(self.state_dict(), strict=False)
        getattr(network, added.name).start_like(self)
        return network

    def groups_by_number(self, text: Tensor) -> Tensor | None:
        """(B, K) int64 groups of categories by the numbers that ``text`` (B, L, W) gives; None without such a module.

        See :meth:`~agents.networks.flux_modules.CountConditioning.groups_by_number`.
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
        self, slots: Tensor, words: Tensor | None, condition: Tensor, text_mask: Tensor | None,
        biases: Tensor | None, scene: Scene,
    ) -> Tensor:  # fmt: skip
        """Slots (B, N, H) and words (B, L, H) through all blocks to slots (B, N, H)."""
        if biases is not None and scene.slot_mask is not None:  # once for all blocks
            absent = torch.zeros_like(scene.slot_mask, dtype=biases.dtype).masked_fill_(~scene.slot_mask, -torch.inf)
            biases = biases.add_(absent[:, None, None])
        chosen: Iterator[Tensor | None] = itertools.repeat(None) if biases is None else iter(biases)
        reaches = words is not None and self.config.text_reach == "all"
        if words is not None:
            for place, block in enumerate(self.double_blocks, 1):
                asks = reaches or place < len(self.double_blocks)
                mask = _mask(next(chosen), text_mask, scene.slot_mask, words.shape[1], slots, asks)
                slots, words = block(slots, words, condition, mask, scene.pairs)
        count = words.shape[1] if reaches and words is not None else 0
        slots = torch.cat([words, slots], dim=1) if reaches and words is not None else slots
        for block in self.single_blocks:
            mask = _mask(next(chosen), text_mask if count else None, scene.slot_mask, count, slots[:, count:])
            slots = block(slots, condition, mask, scene.pairs)
        return slots[:, count:]

    # -- modules ----------------------------------------------------------------------------------

    def _build_modules(self, place: Place) -> None:
        """Add the modules of this ``place``, with fresh weights."""
        for module in self.config.modules:
            if module.place == place:
                self.add_module(module.name, module.build(self.config))

    def _added(self) -> Iterator[FluxModule]:
        return (getattr(self, module.name) for module in self.config.modules if module.name not in self.left_out)

    def _add(self, value: Tensor, hook: Callable[[FluxModule], Tensor | None]) -> Tensor:
        """``value`` plus what a hook of every module returns."""
        for module in self._added():
            part = hook(module)
            value = value if part is None else value + part
        return value

    def take_text(self, scene: Scene, text: Tensor | None, mask: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
        """The tokens after those of single modules, with their mask; puts theirs, and the mean, into ``scene``."""
        if text is None:
            return None, mask
        for module in self.config.modules:
            count = module.text_tokens(self.config)
            if count:
                scene.own_text[module.name], text = text[:, :count], text[:, count:]
                mask = None if mask is None else mask[:, count:]
        if mask is None:
            scene.summary = text.mean(dim=1)
        else:
            real = mask[..., None].to(text)
            scene.summary = (text * real).sum(dim=1) / real.sum(dim=1).clamp(min=1.0)
        return text, mask

    def _read_geometry(self, scene: Scene, position: Tensor | None, noise_level: Tensor | None) -> None:
        """Put translations in metres, rotations, and the noise on them into ``scene``, where modules read them."""
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

    def _relate(self, scene: Scene) -> Tensor | None:
        """The biases (blocks, B, heads, N, N) of the blocks; puts features of pairs into ``scene``."""
        parts = [part for module in self._added() if (part := module.relations(scene)) is not None]
        if not parts:
            return None
        biases, features = zip(*parts, strict=True)
        scene.pairs = features[0] if len(features) == 1 else torch.cat(features, dim=-1)
        return biases[0] if len(biases) == 1 else torch.stack(biases).sum(dim=0)


def _mask(
    bias: Tensor | None, text_mask: Tensor | None, slot_mask: Tensor | None, count: int, slots: Tensor,
    asks: bool = True,
) -> Tensor | None:  # fmt: skip
    """Mask of attention over ``count`` = L words, then N slots, for words and slots, or slots alone: float with
    ``bias``, else (B, 1, 1, L + N) bool; None where nothing is masked.

    Args:
        bias: (B, heads, N, N) of the slots, -inf on padding; None without relations.
        text_mask: (B, L) bool.
        slot_mask: (B, N) bool.
        count: L.
        slots: (B, N, H).
        asks: whether words attend, too.
    """
    if bias is not None:
        if count:
            bias = F.pad(bias, (count, 0, count if asks else 0, 0))
        if count and text_mask is not None:
            bias[..., :count].masked_fill_(~text_mask[:, None, None], -torch.inf)
        if count and asks and slot_mask is not None:
            bias[..., :count, count:].masked_fill_(~slot_mask[:, None, None], -torch.inf)
        return bias
    if text_mask is None and slot_mask is None:
        return None
    everywhere = torch.ones(len(slots), count + slots.shape[1], dtype=torch.bool, device=slots.device)
    words = everywhere[:, :count] if text_mask is None or not count else text_mask
    present = everywhere[:, count:] if slot_mask is None else slot_mask
    return torch.cat([words, present], dim=1)[:, None, None]


def _continuous_sizes(keys: Mapping[str, Any]) -> dict[str, Any]:
    if keys["text_width"]:
        raise InvalidInputError(f"text_width={keys['text_width']}: the continuous flux network reads no text; use 0")
    return {name: keys[name] for name in ("hidden", "depth", "heads", "frequencies")}


def _mixed_sizes(keys: Mapping[str, Any]) -> dict[str, Any]:
    core = ("hidden", "heads", "text_width", "text_reach", "pose_head", "time_scale", "unit", "rotations")
    chosen = keys["modules"] if keys["modules"] is not None else [ObservedFlagsConfig()]
    octaves = keys["frequencies"]
    modules = [make_module(entry) for entry in chosen] + ([FourierFeaturesConfig(octaves)] if octaves else [])
    return {
        **{name: keys[name] for name in core},
        "double_blocks": max(1, keys["depth"] // 3) if keys["double_blocks"] is None else keys["double_blocks"],
        "single_blocks": keys["depth"],
        "embedding": keys["hidden"] if keys["embedding"] is None else keys["embedding"],
        "time_input": "log_noise" if octaves else "timestep",
        "modules": tuple(sorted(modules, key=lambda module: list(MODULES).index(module.name))),
    }


register_network("flux", "continuous", FluxConfig, FluxDenoiser, sizes=_continuous_sizes)
register_network("flux", "mixed", MixedFluxConfig, MixedFlux, sizes=_mixed_sizes)
