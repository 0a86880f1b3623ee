"""Protocols of rewards and priors for the environments, which import neither."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from torch import Generator, Tensor

from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType


class RewardResult(Protocol):
    """Result of a reward for B scenes with N slots."""

    @property
    def value(self) -> Tensor:
        """(B,) float32, larger is better; any value in rows that are not valid."""

    @property
    def is_valid(self) -> Tensor:
        """(B,) bool: rows that could be scored."""

    @property
    def terms(self) -> Mapping[str, Tensor]:
        """Named (B,) floats worth logging."""

    @property
    def per_object(self) -> Tensor | None:
        """(B, N) float credit per slot, or None."""

    @property
    def object_flags(self) -> Mapping[str, Tensor]:
        """Named (B, N) bools, such as ``"feasible"``."""


class SceneScorer(Protocol):
    """A reward as environments call it. A reward that fails gives invalid rows and does not raise."""

    def __call__(self, batch: SceneBatch, *, prompts: tuple[str, ...] | None = None, pool: Any = None) -> RewardResult:
        """Score B scenes, made for ``prompts`` if any, with worker processes ``pool`` for physics if any."""


class StepTableLike(Protocol):
    """Explicit reverse steps: step ``i`` goes from ``timesteps[i]`` to ``previous[i]`` (0 is clean data)."""

    @property
    def timesteps(self) -> Tensor:
        """(S,) int64, strictly decreasing, in 1..T."""

    @property
    def previous(self) -> Tensor:
        """(S,) int64, the timestep after each step; the last is 0."""

    def __len__(self) -> int: ...


@runtime_checkable
class PriorLike(Protocol):
    """A trained denoiser with its schedule, layout and normalizer; all tensors are normalised scenes x (B, N, D)."""

    @property
    def scene_type(self) -> SceneType: ...

    @property
    def normalizer(self) -> Normalizer: ...

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""

    def step_table(self, num_steps: int) -> StepTableLike:
        """The reverse steps of a chain of ``num_steps``."""

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D): standard normal with the known entries clamped."""

    def clamp(self, x: Tensor) -> Tensor:
        """``x`` with its known entries (fixed welded slots, constant features) set to their values."""

    def transition(self, x_t: Tensor, step: int, table: StepTableLike) -> Any:
        """p(x_{t-1} | x_t) at ``table.timesteps[step]``, an object with ``from_noise(noise)``. Known entries are
        certain; at the last step all entries are certain.
        """

    def inpaint(
        self, batch: SceneBatch, mask: Tensor, *, num_steps: int, generators: list[Generator] | None = None
    ) -> SceneBatch:
        """Regenerate the slots where ``mask`` (B, N) is True, keep the others bit-identical."""


@runtime_checkable
class EncodedPriorLike(PriorLike, Protocol):
    """A prior that may denoise scenes in another layout than the scene type's, such as quaternions for rotations; the
    last C + 1 features of a slot are its category in every layout.
    """

    @property
    def features(self) -> int:
        """D, numbers per slot in the layout that is denoised."""

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes of x (B, N, D)."""


class PromptedPriorLike(PriorLike, Protocol):
    """A prior whose ``conditional`` is True: it reads prompts."""

    @property
    def prompt_space(self) -> tuple[int, int]:
        """Largest number of tokens of a prompt, and size of the vocabulary; 0 is padding."""

    def read_prompts(self, prompts: Sequence[str], slots: int) -> Tensor:
        """Token indices (B, L) int64 on the CPU; ``""`` stands for no prompt."""

    def encode_tokens(self, indices: Tensor) -> Any:
        """Text that the network attends to, from token indices (B, L)."""

    def transition(
        self, x_t: Tensor, step: int, table: StepTableLike, *, text: Any = None, guidance: float = 0.0
    ) -> Any:
        """As for any prior, given ``text`` as :meth:`encode_tokens` returns it."""

    def inpaint(
        self,
        batch: SceneBatch,
        mask: Tensor,
        *,
        num_steps: int,
        generators: list[Generator] | None = None,
        prompt: str | Sequence[str] | None = None,
        guidance: float = 0.0,
    ) -> SceneBatch:
        """As for any prior; the whole scenes follow ``prompt``."""
