"""The interface of modules that are added to the Flux core: what they read, and where they join it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, Protocol

from torch import Tensor, nn

Place = Literal["slots", "condition", "attention", "output"]
"""The part of the core after which the weights of a module are drawn, so that a seed keeps giving the same weights."""


class FluxSizes(Protocol):
    """The sizes of the core that modules are built for; fields of :class:`~agents.networks.MixedFluxConfig`."""

    @property
    def categories(self) -> int:
        """Assets and *empty*."""

    @property
    def hidden(self) -> int:
        """Width of the token streams."""

    @property
    def heads(self) -> int:
        """Attention heads."""

    @property
    def embedding(self) -> int:
        """Width of the embedding of a slot."""

    @property
    def text_width(self) -> int:
        """Width of the text tokens; 0 without text."""

    @property
    def unit(self) -> tuple[float, float, float]:
        """Metres per normalised unit along x, y, z."""

    @property
    def blocks(self) -> int:
        """Number of blocks, of both kinds."""

    @property
    def pair_width(self) -> int:
        """Number of features of a pair of slots, summed over all modules."""


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
    kept: dict[str, Tensor] = field(default_factory=dict)


class FluxModule(nn.Module):
    """A part of the network beside its core. Every hook may be left out; None adds nothing.

    The core calls the hooks in the order in which they are defined here. It calls each hook for all modules, in the
    order of the configuration, and adds what they return. All must be permutation-equivariant in the slots.
    """

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


@dataclass(frozen=True)
class ModuleConfig(ABC):
    """Configuration of a module; subclasses are frozen dataclasses whose fields go into files as they are.

    Attributes:
        name: of the module, in files and as the first part of the names of its weights.
        place: after which part of the core its weights are drawn.
        requires: names of modules that must stand before it.
        reads_geometry: whether it reads positions and the noise on them.
        reads_rotations: whether it reads rotations, too.
        reads_text: whether it needs a network with text.
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    requires: ClassVar[Sequence[str]] = ()
    reads_geometry: ClassVar[bool] = False
    reads_rotations: ClassVar[bool] = False
    reads_text: ClassVar[bool] = False

    @property
    def pose_width(self) -> int:
        """Numbers per slot that the module adds to each pose."""
        return 0

    @property
    def pair_width(self) -> int:
        """Number of features of a pair of slots that the module computes."""
        return 0

    def text_tokens(self, core: FluxSizes) -> int:
        """Number of leading text tokens that are for this module alone."""
        return 0

    @abstractmethod
    def build(self, core: FluxSizes) -> FluxModule:
        """The module with fresh weights, for a network of this configuration."""
