"""What the environments need from rewards and priors, without importing either."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from torch import Generator, Tensor

from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType


class RewardResult(Protocol):
    """What a reward returns; see ``rewards.RewardOutput``."""

    @property
    def value(self) -> Tensor:
        """(B,)."""
        ...

    @property
    def is_valid(self) -> Tensor:
        """(B,) bool."""
        ...


@runtime_checkable
class RewardLike(Protocol):
    """Scores a batch of scenes; see ``rewards.Reward``."""

    def __call__(self, batch: SceneBatch, context: Any) -> RewardResult: ...


class StepTableLike(Protocol):
    """Explicit reverse steps: step ``i`` goes from ``timesteps[i]`` to ``previous[i]`` (0 is clean data)."""

    @property
    def timesteps(self) -> Tensor:
        """(S,) int64, strictly decreasing, in 1..T."""
        ...

    @property
    def previous(self) -> Tensor:
        """(S,) int64, where each step lands; the last is 0."""
        ...

    def __len__(self) -> int: ...


@runtime_checkable
class PriorLike(Protocol):
    """A trained denoiser with its schedule, layout and normalizer; see ``agents.priors.base.ScenePrior``.

    All tensors are normalised scenes x (B, N, D).
    """

    @property
    def scene_type(self) -> SceneType: ...

    @property
    def normalizer(self) -> Normalizer: ...

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""
        ...

    def step_table(self, num_steps: int) -> StepTableLike:
        """The reverse steps of a chain of ``num_steps``."""
        ...

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D): standard normal with the known entries clamped."""
        ...

    def clamp(self, x: Tensor) -> Tensor:
        """``x`` with its known entries (fixed welded slots, constant features) set to their values."""
        ...

    def transition(self, x_t: Tensor, step: int, table: StepTableLike) -> Any:
        """p(x_{t-1} | x_t) at ``table.timesteps[step]``, an object like ``agents.diffusion.ReverseStep``.

        Known entries are certain; at the last step all are.
        """
        ...

    def inpaint(
        self, batch: SceneBatch, mask: Tensor, *, num_steps: int, generators: list[Generator] | None = None
    ) -> SceneBatch:
        """Regenerate the slots where ``mask`` (B, N) is True, keep the others bit-identical."""
        ...


@runtime_checkable
class EncodedPriorLike(PriorLike, Protocol):
    """A prior that may denoise scenes in another layout than the scene type's, such as quaternions for rotations.

    The last C + 1 features of a slot are its category in every layout.
    """

    @property
    def features(self) -> int:
        """D, numbers per slot of what is denoised."""
        ...

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes of x (B, N, D)."""
        ...


class PromptedPriorLike(PriorLike, Protocol):
    """A prior whose ``conditional`` is True: it reads prompts; see ``agents.priors.text.PromptReader``."""

    @property
    def prompt_space(self) -> tuple[int, int]:
        """How many tokens a prompt has at most, and how many different ones there are; 0 is padding."""
        ...

    def read_prompts(self, prompts: Sequence[str], slots: int) -> Tensor:
        """Token indices (B, L) int64 on the CPU; ``""`` stands for no prompt."""
        ...

    def encode_tokens(self, indices: Tensor) -> Any:
        """What the network attends to, from token indices (B, L)."""
        ...

    def transition(
        self, x_t: Tensor, step: int, table: StepTableLike, *, text: Any = None, guidance: float = 0.0
    ) -> Any:
        """As for any prior, given ``text`` as :meth:`encode_tokens` returns it."""
        ...

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
        """As for any prior, the whole scenes following ``prompt``."""
        ...


def resolve_reward(reward: Any) -> Any:
    """A reward object from a name, a mapping, a function or a reward (loads the ``rewards`` package)."""
    return import_module("rewards").resolve_reward(reward)


def reward_context(**fields: Any) -> Any:
    """A ``rewards.RewardContext`` with the given fields."""
    return import_module("rewards").RewardContext(**fields)


def resolve_prior(prior: Any) -> PriorLike:
    """A prior from a name, a path or a prior (loads the ``agents`` package)."""
    if isinstance(prior, str):
        return import_module("agents.priors.base").ScenePrior.load(prior)  # type: ignore[no-any-return]
    return prior  # type: ignore[no-any-return]
