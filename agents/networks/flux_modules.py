"""Modules that are added to the Flux core: their interface, and those that read flags, text, counts or translations.

Attention computes averages, but numbers of objects depend on each other and on a prompt: three modules count. Modules
that read relative positions and rotations are in :mod:`agents.networks.geometry`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Place = Literal["slots", "condition", "attention", "output"]
"""The part of the core after which the weights of a module are drawn, so that a seed keeps giving the same weights."""
_COUNT_SCALE = 8.0  # divisor of counts as inputs
_ONE_HOT = 16  # count logits read counts below it one-hot as well


@dataclass
class Scene:
    """A batch of B noisy scenes of N slots, as modules read it.

    Attributes:
        states: (B, N) int64 categories in 0..K, K being the mask token.
        observed: (B, N) int64, 1 where the pose is observed, plus 2 where the category is; None if nothing is
            observed.
        slot_mask: (B, N) bool, False for padding slots; None where there are none.
        summary: (B, W) mean of the text tokens; None without text.
        own_text: leading text tokens (B, T, W) that only one module reads, by the name of the module.
        position: (B, N, 12) noisy poses in signal units, or translations alone (B, N, 3); None where no module reads
            geometry.
        noise_level: (B, N) noise-to-signal ratio of ``position``.
        metres: (B, N, 3) translations.
        metres_noise: (B, N, 3) standard deviation of the noise on ``metres``.
        noisy_rotation: (B, N, 3, 3) matrices with their noise, where a module reads rotations.
        rotation: (B, N, 3, 3) the rotations nearest to ``noisy_rotation``.
        rotation_noise: (B, N) standard deviation of the noise on the entries of a rotation.
        pairs: (B, N, N, F) features of pairs of slots, of all modules together; None before any are computed.
        estimate: offset and scale, (B, N, 12) each: offset + scale * pose output is the denoised pose, in signal units;
            None where no module reads it.
        kept: tensors that a module stores in one hook for a later hook of its own, by the name of the module.
    """

    states: Tensor
    observed: Tensor | None = None
    slot_mask: Tensor | None = None
    summary: Tensor | None = None
    own_text: dict[str, Tensor] = field(default_factory=dict)
    position: Tensor | None = None
    noise_level: Tensor | None = None
    metres: Tensor | None = None
    metres_noise: Tensor | None = None
    noisy_rotation: Tensor | None = None
    rotation: Tensor | None = None
    rotation_noise: Tensor | None = None
    pairs: Tensor | None = None
    estimate: tuple[Tensor, Tensor] | None = None
    kept: dict[str, Tensor] = field(default_factory=dict)


def start_at_zero(*layers: nn.Module) -> None:
    """Set all weights and biases of ``layers`` to zero."""
    for layer in layers:
        for parameter in layer.parameters():
            nn.init.zeros_(parameter)


class FluxModule(nn.Module):
    """A part of the network outside of its core. Every hook may be left out; None adds nothing.

    The core calls the hooks in the order in which they are defined here. It calls each hook for all modules, in the
    order of the configuration, and adds what they return. All must be permutation-equivariant in the slots.
    """

    def start_like(self, network: Any) -> None:
        """Take weights of a trained network, to which the module is added."""

    def condition(self, scene: Scene) -> Tensor | None:
        """(B, H) that is added to the embedded time, which modulates every block."""
        return None

    def pose_features(self, scene: Scene) -> Tensor | None:
        """(B, N, ``pose_width``) that is concatenated to the poses."""
        return None

    def slot_features(self, scene: Scene) -> Tensor | None:
        """(B, N, E) that is added to the embedded slots."""
        return None

    def relations(self, scene: Scene) -> tuple[Tensor, Tensor] | None:
        """Biases (blocks, B, heads, N, N) of the attention between slots, and features of pairs (B, N, N, F).

        F is ``pair_width``. Attention sums the features with its weights, and later hooks find them in ``scene.pairs``.
        """
        return None

    def messages(self, scene: Scene) -> Tensor | None:
        """(B, N, H) that is added to the tokens of the slots before the first block."""
        return None

    def logits(self, scene: Scene) -> Tensor | None:
        """(B, 1 or N, K) that is added to the logits of the categories."""
        return None

    def groups_by_number(self, tokens: Tensor) -> Tensor | None:
        """(B, K) int64 groups of the categories, from the module's own text ``tokens`` (B, L, W).

        The core calls this outside of a forward pass, and takes the groups of the first module that returns some.
        """
        return None

    def pose_output(self, scene: Scene, features: Tensor) -> Tensor | None:
        """(B, N, 12) that is added to the pose output; ``features`` (B, N, E) leave the core's last layer."""
        return None

    def correction(self, scene: Scene, tokens: Tensor, condition: Tensor, output: Tensor) -> Tensor | None:
        """(B, N, 12) that is added to the pose ``output`` (B, N, 12), for modules that read the denoised scene.

        ``tokens`` (B, N, H) leave the last block; ``condition`` (B, H) modulates the blocks.
        """
        return None


@dataclass(frozen=True)
class ModuleConfig(ABC):
    """Configuration of a module; subclasses are frozen dataclasses whose fields go into files as they are.

    Methods take the :class:`~agents.networks.MixedFluxConfig` of the network as ``core``.

    Attributes:
        name: name of the module, in files and as the first part of the names of its weights.
        place: after which part of the core its weights are drawn.
        requires: names of modules that must stand before it.
        reads_geometry: whether it reads positions and the noise on them.
        reads_rotations: whether it reads rotations, too.
        reads_text: whether it needs a network with text.
        reads_estimate: whether it reads the denoised scene.
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    requires: ClassVar[Sequence[str]] = ()
    reads_geometry: ClassVar[bool] = False
    reads_rotations: ClassVar[bool] = False
    reads_text: ClassVar[bool] = False
    reads_estimate: ClassVar[bool] = False

    @property
    def pose_width(self) -> int:
        """Numbers per slot that the module adds to each pose."""
        return 0

    @property
    def pair_width(self) -> int:
        """Number of features of a pair of slots that the module computes."""
        return 0

    def text_tokens(self, core: Any) -> int:
        """Number of leading text tokens that are for this module alone."""
        return 0

    @abstractmethod
    def build(self, core: Any) -> FluxModule:
        """The module with fresh weights, for a network with the configuration ``core``."""


@dataclass(frozen=True)
class ObservedFlagsConfig(ModuleConfig):
    """An embedding of which entries of a slot are observed."""

    name = "observed_flags"
    place = "slots"

    def build(self, core: Any) -> ObservedFlags:
        return ObservedFlags(core.embedding)


class ObservedFlags(FluxModule):
    """An embedding (B, N, E) of what is observed (neither, pose, category or both); it starts at zero."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(4, width)
        nn.init.zeros_(self.embedding.weight)

    def slot_features(self, scene: Scene) -> Tensor | None:
        return None if scene.observed is None else self.embedding(scene.observed)


@dataclass(frozen=True)
class PooledTextConfig(ModuleConfig):
    """The mean of the text tokens, which then modulates every block."""

    name = "pooled_text"
    place = "condition"
    reads_text = True

    def build(self, core: Any) -> PooledText:
        return PooledText(core.text_width, core.hidden)


class PooledText(FluxModule):
    """A linear map (B, H) of the mean text token (B, W)."""

    def __init__(self, text_width: int, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Linear(text_width, hidden, bias=False)

    def condition(self, scene: Scene) -> Tensor | None:
        return None if scene.summary is None else self.linear(scene.summary)


@dataclass(frozen=True)
class CountEmbeddingConfig(ModuleConfig):
    """Counts of visible slots, read together with the mean text token where there is text."""

    name = "count_embedding"
    place = "condition"

    def build(self, core: Any) -> CountEmbedding:
        return CountEmbedding(core.categories, core.text_width, core.hidden)


def count_states(states: Tensor, categories: int, slot_mask: Tensor | None = None) -> Tensor:
    """(B, K) numbers of slots in each category; in the place of *empty*, the number of masked slots.

    Empty slots are not counted, so that leaving them out of the network's batch changes nothing.

    Args:
        states: (B, N) int64 in 0..K, K being the mask token and K - 1 *empty*.
        categories: K.
        slot_mask: (B, N) bool, False for padding slots; None where there are none.

    >>> count_states(torch.tensor([[0, 0, 1, 2, 3, 3]]), 3).tolist()
    [[2.0, 1.0, 2.0]]
    """
    seen = torch.ones_like(states, dtype=torch.float32) if slot_mask is None else slot_mask.float()
    counts = seen.new_zeros(len(states), categories + 1).scatter_add_(1, states, seen)
    return torch.cat([counts[:, : categories - 1], counts[:, categories:]], dim=1)


class CountEmbedding(FluxModule):
    """Counts of visible slots and the mean text token (zeros without text), to one vector (B, H)."""

    def __init__(self, categories: int, text_width: int, hidden: int) -> None:
        super().__init__()
        self.categories, self.text_width = categories, text_width
        self.layers = nn.Sequential(
            nn.Linear(2 * categories + text_width, 2 * hidden), nn.SiLU(), nn.Linear(2 * hidden, hidden)
        )

    def condition(self, scene: Scene) -> Tensor | None:
        return self.layers(_counts_and_text(scene, self.categories, self.text_width, next(self.parameters())))


def _counts_and_text(scene: Scene, categories: int, text_width: int, like: Tensor) -> Tensor:
    """(B, 2K + W) counts of visible slots, on two scales, and the mean text token, in the number format of ``like``."""
    counts = count_states(scene.states, categories, scene.slot_mask).to(like.dtype)
    text = counts.new_zeros(len(counts), text_width) if scene.summary is None or not text_width else scene.summary
    return torch.cat([counts / _COUNT_SCALE, counts.log1p(), text], dim=1)


@dataclass(frozen=True)
class CountLogitsConfig(ModuleConfig):
    """Logits of the categories from the numbers of visible objects."""

    name = "count_logits"
    place = "output"

    def build(self, core: Any) -> CountLogits:
        return CountLogits(core.categories, core.text_width)


class CountLogits(FluxModule):
    """Logits (B, 1, K) that are added to those of every slot, from counts of visible slots and the mean text token.

    Numbers of objects depend on each other: a table of a restaurant has four chairs. Modulated blocks learn it slowly,
    and two layers on all counts, one-hot below 16, fast. The logits start at zero. Completions leave them
    out, and so does classifier-free guidance, which would amplify them.

    >>> module = CountLogits(categories=3, text_width=0)
    >>> module.logits(Scene(torch.tensor([[0, 0, 1, 2, 3, 3]]))).tolist()
    [[[0.0, 0.0, 0.0]]]
    """

    def __init__(self, categories: int, text_width: int, width: int = 256) -> None:
        super().__init__()
        self.categories, self.text_width = categories, text_width
        self.layers = nn.Sequential(
            nn.Linear((2 + _ONE_HOT) * categories + text_width, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, categories),
        )  # fmt: skip
        start_at_zero(self.layers[-1])

    def inputs(self, scene: Scene) -> Tensor:
        """(B, 2K + W) what :meth:`from_inputs` reads of a scene."""
        return _counts_and_text(scene, self.categories, self.text_width, next(self.parameters()))

    def from_inputs(self, inputs: Tensor) -> Tensor:
        """(B, 1, K) logits from :meth:`inputs`."""
        numbers = torch.arange(_ONE_HOT, device=inputs.device)
        same = (inputs[:, : self.categories, None] * _COUNT_SCALE).round() == numbers
        return self.layers(torch.cat([inputs, same.flatten(1).to(inputs.dtype)], dim=1))[:, None]

    def logits(self, scene: Scene) -> Tensor:
        return self.from_inputs(self.inputs(scene))


_DELTA = 0.02  # number of objects that is added before a logarithm is taken, so that it is finite
_KNOWN = 0.8  # a text gives the number of a kind if the likeliest number has at least this probability
_MIN_REST = 0.1  # below this probability of the visible number and all larger ones, fewer objects are expected
_TINY = 1e-9


@dataclass(frozen=True)
class CountConditioningConfig(ModuleConfig):
    """Numbers that a prompt asks for; the first text tokens are of the kinds of objects, and of all objects.

    Attributes:
        largest: largest number that has a class of its own.
        kinds: (K - 1,) the kind of each category, as prompts call it; empty where each is one of its own.
    """

    largest: int
    kinds: tuple[int, ...] = ()

    name = "count_conditioning"
    place = "condition"
    reads_text = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "kinds", tuple(self.kinds))  # a list, when it comes from JSON

    def kinds_of(self, core: Any) -> tuple[int, ...]:
        """The kind of each category."""
        return self.kinds or tuple(range(core.categories - 1))

    def text_tokens(self, core: Any) -> int:
        return max(self.kinds_of(core)) + 2

    def build(self, core: Any) -> CountConditioning:
        return CountConditioning(self.kinds_of(core), core.text_width, core.hidden, self.largest)


class CountConditioning(FluxModule):
    """Logits (B, K) that are added to those of every slot: how much of each category is still wanted.

    A prompt asks for numbers: of objects, of cups, of any kind. Attention takes averages and learns exact
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
        most: largest number that has a class of its own; larger numbers count as this one.

    Attributes:
        things: number of kinds G plus one for all objects.

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
        start_at_zero(self.out)

    def count_logits(self, tokens: Tensor) -> Tensor:
        """(B, G + 1, most + 1) logits of the numbers of each kind and of all objects, from ``tokens`` (B, G + 1, W)."""
        return self.counts_out(tokens)

    def count_loss(self, tokens: Tensor, states: Tensor) -> Tensor:
        """(B,) mean over kinds and objects of the cross-entropy of their numbers in scenes (B, N) of 0..K-1."""
        numbers = self._numbers(count_states(states, self.categories)).long().clamp(max=self.most)
        return F.cross_entropy(self.count_logits(tokens).transpose(1, 2), numbers, reduction="none").mean(dim=1)

    def logits(self, scene: Scene) -> Tensor | None:
        tokens = scene.own_text.get(CountConditioningConfig.name)
        return None if tokens is None else self(scene.states, tokens, scene.slot_mask)[:, None]

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
    visible one have less than ``_MIN_REST`` together. Then more objects are visible than the text asks for. Without
    this bound the mean would be that of the remote tail, and all masked slots would become objects of a kind that is
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
    least = torch.where(probability[..., 1:].amax(dim=-1) >= _KNOWN, _MIN_REST, _TINY)
    return (weight * beyond).sum(dim=-1) / weight.sum(dim=-1).maximum(least)


@dataclass(frozen=True)
class FourierFeaturesConfig(ModuleConfig):
    """Fourier features of each translation.

    Attributes:
        octaves: F, waves per axis; the longest has half a period per normalised unit.
    """

    octaves: int = 8

    name = "fourier_features"
    place = "slots"
    reads_geometry = True

    @property
    def pose_width(self) -> int:
        return 6 * self.octaves

    def build(self, core: Any) -> FourierFeatures:
        return FourierFeatures(self.octaves)


class FourierFeatures(FluxModule):
    """Sines and cosines (B, N, 6 F) of translations, each damped to its mean under the noise.

    Under Gaussian noise of standard deviation s, E sin(w x) is sin(w x) exp(-w^2 s^2 / 2).
    """

    def __init__(self, octaves: int) -> None:
        super().__init__()
        self.octaves: Tensor
        values = math.pi * 2.0 ** torch.arange(octaves, dtype=torch.float32)
        self.register_buffer("octaves", values, persistent=False)

    def pose_features(self, scene: Scene) -> Tensor | None:
        if scene.position is None or scene.noise_level is None:
            return None
        return self(scene.position, scene.noise_level)

    def forward(self, position: Tensor, noise_level: Tensor) -> Tensor:
        """Features of the first three numbers of ``position`` (B, N, D) under noise (B, N)."""
        angle = position[..., :3, None] * self.octaves  # (B, N, 3, F)
        damping = torch.exp(-0.5 * (self.octaves * noise_level[..., None]) ** 2).unsqueeze(-2)  # (B, N, 1, F)
        return torch.cat([(angle.sin() * damping).flatten(-2), (angle.cos() * damping).flatten(-2)], dim=-1)
