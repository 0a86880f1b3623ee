"""What the environments need from rewards and priors, without importing either."""

from __future__ import annotations

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
    """A trained denoiser with its schedule, layout and normalizer; see ``agents.prior.ScenePrior``.

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


def resolve_reward(reward: Any) -> Any:
    """A reward object from a name, a mapping, a function or a reward (loads the ``rewards`` package)."""
    return import_module("rewards").resolve_reward(reward)


def reward_context(**fields: Any) -> Any:
    """A ``rewards.RewardContext`` with the given fields."""
    return import_module("rewards").RewardContext(**fields)


def resolve_prior(prior: Any) -> PriorLike:
    """A prior from a name, a path or a prior (loads the ``agents`` package)."""
    if isinstance(prior, str):
        return import_module("agents.prior").ScenePrior.load(prior)  # type: ignore[no-any-return]
    return prior  # type: ignore[no-any-return]
