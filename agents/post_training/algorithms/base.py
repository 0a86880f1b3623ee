"""Base classes of post-training algorithms, sums of gradients, and advantages."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, make_dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Generator, Tensor, nn
from torchrl.objectives import LossModule

from agents.networks.text import Text
from agents.post_training.policy import DenoisingPolicy
from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup, gather_rows
from agents.utils.weight_average import WeightAverage
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True)
class BatchGradient:
    """Statistics of the gradient that a batch added to ``.grad``: the loss, and further columns of the log."""

    loss: float  # over the scenes of all processes
    columns: Mapping[str, float] = field(default_factory=dict)


class Algorithm(ABC):
    """Rule that turns a batch of scenes into a gradient.

    Attributes:
        policy: reverse chain of the prior in training.
        advantage: module that writes the advantages which the loss reads; None where the scenes are not weighted.
        loss: torchrl loss whose gradient trains the prior.
        average: averaged weights that are evaluated and saved; None evaluates and saves the weights in training.
    """

    policy: DenoisingPolicy
    advantage: TensorDictModuleBase | None = None
    loss: LossModule
    average: WeightAverage | None = None

    @cached_property
    def sampling_policy(self) -> DenoisingPolicy:
        """Policy that samples the scenes; the policy in training unless an algorithm sets another."""
        return self.policy

    @abstractmethod
    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """Add the gradient of a batch to ``.grad``; everything random is drawn from ``generator`` (CPU).

        The batch [B, S] is that of :func:`~agents.post_training.rollouts.collect`, after :attr:`advantage`. With
        several processes, each process adds the gradient of its own scenes, as a part of the mean over all scenes. The
        training loop sums these parts.
        """

    def end_iteration(self) -> None:
        """Called after the last update of every batch."""
        return

    def return_to(self, prior: ScenePrior) -> None:
        """Called after the weights in training were replaced by those of ``prior``, an earlier checkpoint."""
        return

    def state(self) -> dict[str, Any]:
        """State that a resumed run needs in addition to the weights in training."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        return


class AveragedSampler(Algorithm):
    """An algorithm that samples with ``sampler``, a copy of ``prior`` whose weights are also evaluated and saved. After
    each batch it moves towards ``prior``; ``sampler_decay`` is the final decay per batch of this
    :class:`~agents.utils.weight_average.WeightAverage`.
    """

    average: WeightAverage

    def __init__(self, policy: DenoisingPolicy, *, sampler_decay: float, warm_up: float = 10.0) -> None:
        self.policy = policy
        self.prior: ScenePrior = policy.prior  # type: ignore[assignment]
        self.sampler = deepcopy(self.prior).eval().requires_grad_(False)
        self.sampling_policy = DenoisingPolicy(  # it needs no log-probabilities
            self.sampler, len(policy), chunk=policy.chunk, guidance=policy.guidance, independent=False
        )
        self.average = WeightAverage(self.prior, sampler_decay, warm_up)

    def end_iteration(self) -> None:
        """Move the copy towards the prior in training."""
        self.average.update(self.prior)
        self.average.copy_to(self.sampler)

    def return_to(self, prior: ScenePrior) -> None:
        """Sample with the weights of ``prior``, and begin their average anew."""
        self.average = WeightAverage(prior, self.average.decay, self.average.warm_up)
        self.average.copy_to(self.sampler)

    def state(self) -> dict[str, Any]:
        """The weights of the copy, and the number of their updates."""
        return {"sampler": self.average.tensors, "updates": self.average.updates}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.average.restore(state["sampler"], state["updates"])
        self.average.copy_to(self.sampler)


def accepted_keys(*names: str, **keys: str) -> type:
    """Dataclass of the keys that a loss reads, for :class:`PlainLoss`: ``names`` under themselves, others as given."""
    defaults = {**{name: name for name in (*names, "text", "text_mask")}, **keys}
    return make_dataclass("_AcceptedKeys", [(name, NestedKey, key) for name, key in defaults.items()])


class PlainLoss(LossModule):
    """A torchrl loss whose gradient goes to the modules' own parameters, and which has no value estimator. A subclass
    names its keys: ``default_keys = _AcceptedKeys = accepted_keys(...)``, and those that must be present, ``required``.
    """

    tensor_keys: Any
    required: ClassVar[Sequence[str]]

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """Keys that must be present."""
        return [getattr(self.tensor_keys, name) for name in self.required]

    @property
    def functional(self) -> bool:
        """False: the modules' own parameters receive the gradient."""
        return False

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        """Do nothing, because there is no value estimator."""

    def _text(self, flat: TensorDictBase) -> Text | None:
        """The text that the network attends to, as constants; None where there is none."""
        tokens, mask = flat.get(self.tensor_keys.text, None), flat.get(self.tensor_keys.text_mask, None)
        return None if tokens is None or mask is None else (tokens.detach(), mask)

    def _advantage(self, flat: TensorDictBase, key: NestedKey, scene: Tensor) -> Tensor:
        """(B, 1) or (B, N) advantages of scenes (B, N, D), as constants."""
        found: Tensor = flat[key].detach().reshape(len(scene), -1)
        if found.shape[1] not in (1, scene.shape[1]):
            raise InvalidInputError(
                f"{key!r} has {found.shape[1]} values per scene; give one, or one per slot ({scene.shape[1]})"
            )
        return found


def in_parts(parameters: Iterable[nn.Parameter], count: int, chunk: int | None) -> Iterator[slice]:
    """Rows of ``count`` scenes, ``chunk`` at a time (None: all), to put the gradient of each part into ``.grad``. At
    the end ``.grad`` has the sum of the parts and of what was there before. Each part is complete before it is added,
    so the sum of two is the same, bit for bit, in one process as in two with one part each.

    >>> weight = nn.Parameter(torch.ones(1))
    >>> for rows in in_parts([weight], count=4, chunk=2):
    ...     (weight * torch.arange(4.0)[rows]).sum().backward()
    >>> weight.grad
    tensor([6.])
    """
    trained = [p for p in parameters if p.requires_grad]
    total = [p.grad for p in trained]
    for start in range(0, count, chunk or count):
        for parameter in trained:
            parameter.grad = None
        yield slice(start, min(start + (chunk or count), count))
        for index, (before, gradient) in enumerate(zip(total, [p.grad for p in trained], strict=True)):
            total[index] = before if gradient is None else gradient if before is None else before.add_(gradient)
    for parameter, gradient in zip(trained, total, strict=True):
        parameter.grad = gradient


MAX_RATIO = 10.0
"""Largest ratio of probabilities in a clipped objective."""


def bounded_ratio(log_ratio: Tensor) -> Tensor:
    """Ratios of probabilities, at most :data:`MAX_RATIO`, from their logarithms; larger ones have no gradient.

    The clip of PPO bounds what an action with a positive advantage gains, not what one with a negative advantage loses:
    one outlier would give the whole gradient, and an infinite ratio makes it NaN. (Dual clip; Ye et al. 2020, Eq. 5)

    >>> bounded_ratio(torch.tensor([0.0, 200.0]))
    tensor([ 1., 10.])
    """
    return log_ratio.clamp(max=math.log(MAX_RATIO)).exp()


def gradient_norm(parameters: Iterable[nn.Parameter]) -> float:
    """Euclidean norm of all ``.grad``; 0 when there is none."""
    norms = [p.grad.norm() for p in parameters if p.grad is not None]
    return float(torch.stack(norms).norm()) if norms else 0.0


_MIN_STD = 1e-8


class Advantage(TensorDictModuleBase):
    """Writes the advantages of whole episodes [B, S], one episode in each row, at all of their steps.

    Scenes with equal prompts are compared with each other. The steps share the memory of one value per episode.

    Reads:
        ("next", "reward"), ("next", "done"): (B, S, 1).
        ("next", "valid"): (B, S, 1) bool, optional; False at the last step where the reward could not score the scene.
        prompt: (B, S, L) int64 token indices, optional.
        per_object, credited: (B, S, N) credit per slot, and bool whether the slot has credit, both optional.

    Writes:
        advantage: (B, S, 1), or (B, S, N) for credit per object.
        valid: (B, S, 1) bool, whether the reward could score the scene at the end of the episode.

    Args:
        credit: ``"scene"``, ``"object"``, or ``"auto"`` for credit per object where there is ``per_object``.
        clip: bound of :func:`compute_advantages`.

    Raises:
        InvalidInputError: a row is not one whole episode, or credit per object is asked of a reward that gives none.

    >>> from tensordict import TensorDict
    >>> done = torch.tensor([[[False], [True]]]).expand(3, 2, 1)
    >>> reward = torch.tensor([0.0, 1.0, 5.0])[:, None, None] * done
    >>> batch = Advantage()(TensorDict({"next": {"reward": reward, "done": done}}, [3, 2]))
    >>> batch["advantage"][:, 0, 0]
    tensor([-1.3887, -0.6944,  2.0831])
    """

    in_keys = [("next", "reward"), ("next", "done")]  # noqa: RUF012  (torchrl reads lists)
    out_keys = ["advantage", "valid"]  # noqa: RUF012

    def __init__(self, *, credit: str = "auto", clip: float = 5.0) -> None:
        super().__init__()
        self.credit, self.clip = credit, clip

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``out_keys``."""
        final = last_steps(tensordict)
        reward, valid = self.credited(final)
        advantage = compute_advantages(reward, valid, clip=self.clip, groups=prompt_groups(final))
        tensordict["advantage"] = at_all_steps(advantage, tensordict)
        tensordict["valid"] = at_all_steps(final_reward(final)[1], tensordict)
        return tensordict

    def credited(self, final: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Rewards and their validity from the last transitions [B]: (B,) with credit per scene, (B, N) per object.

        Raises:
            InvalidInputError: credit per object is asked of a reward that has no ``per_object``.
        """
        reward, valid = final_reward(final)
        per_object = final.get("per_object", None)
        if self.credit == "scene" or (self.credit == "auto" and per_object is None):
            return reward, valid
        if per_object is None:
            raise no_credit_per_object()
        credited = final.get("credited", torch.ones_like(per_object, dtype=torch.bool))
        return per_object.float(), credited & valid[:, None]


class ForwardAdvantage(Advantage):
    """Writes advantages of poses that are not clipped, and ``category_advantage`` (B, S, 1): that of the scene, or
    zeros for no credit. It also reads two optional keys. Slots outside ``judged`` (B, S, N) bool, which the reward does
    not judge, have no advantage of their own: a table of credit 0 would otherwise be repelled like an object that is
    not feasible. ``counts_objects`` (B, S, 1) bool says whether the reward depends on which objects there are; if not,
    and if poses have credit per object, ``category_credit="auto"`` is ``"none"``, and otherwise ``"scene"``.
    """

    out_keys = ["advantage", "category_advantage", "valid"]  # noqa: RUF012

    def __init__(self, *, credit: str = "auto", category_credit: str = "auto") -> None:
        super().__init__(credit=credit, clip=math.inf)
        self.category_credit = category_credit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``out_keys``."""
        final = super().forward(tensordict)[:, -1]
        per_object = self.credited(final)[0].ndim == 2
        poses_alone = per_object and not bool(final.get("counts_objects", torch.zeros(1)).any())
        if self.category_credit == "none" or (self.category_credit == "auto" and poses_alone):
            categories = torch.zeros_like(final["advantage"][:, 0])
        else:
            categories = compute_advantages(*final_reward(final), clip=math.inf, groups=prompt_groups(final))
        return tensordict.set("category_advantage", at_all_steps(categories, tensordict))

    def credited(self, final: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Rewards of slots that are judged, or of scenes."""
        reward, valid = super().credited(final)
        judged = final.get("judged", None)
        return reward, valid if reward.ndim == 1 or judged is None else valid & judged


def last_steps(episodes: TensorDictBase) -> TensorDictBase:
    """The last transitions [B] of whole episodes [B, S]; an InvalidInputError if a row is not one whole episode."""
    done = episodes["next", "done"][..., 0]
    if done.ndim != 2 or not bool(done[:, -1].all()) or bool(done[:, :-1].any()):
        raise InvalidInputError(
            f"a batch of shape {tuple(episodes.shape)} does not hold one whole episode in each row; give "
            "env.rollout the number of steps of an episode, and a collector that number times the environments"
        )
    return episodes[:, -1]


def at_all_steps(values: Tensor, episodes: TensorDictBase) -> Tensor:
    """``values`` (B,) or (B, K) of B episodes [B, S] as (B, S, 1) or (B, S, K), without a copy."""
    values = values[:, None] if values.ndim == 1 else values
    return values[:, None].expand(-1, episodes.shape[1], *values.shape[1:])


def final_reward(final: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Rewards (B,) of episodes from their last transitions [B], and (B,) bool whether the reward could score them."""
    reward, valid = final["next", "reward"][:, 0], final.get(("next", "valid"), None)
    return reward, torch.ones_like(reward, dtype=torch.bool) if valid is None else valid[:, 0]


def prompt_groups(final: TensorDictBase) -> Tensor | None:
    """(B,) int64, equal for scenes with equal prompts, over all processes; None where there are no prompts."""
    prompt = final.get("prompt", None)
    if prompt is None:
        return None
    all_prompts = gather_rows(prompt)
    groups: Tensor = torch.unique(all_prompts, dim=0, return_inverse=True)[1]
    return groups[ProcessGroup.current().rows(len(all_prompts))]


def no_credit_per_object() -> InvalidInputError:
    """The error where credit per object is asked of a reward that gives none."""
    return InvalidInputError(
        "algorithm.credit=object (credit='object') needs a reward with per_object values, and this one scores scenes "
        "only; take algorithm.credit=scene, or auto"
    )


def compute_advantages(
    reward: Tensor, valid: Tensor | None = None, *, clip: float = 5.0, groups: Tensor | None = None
) -> Tensor:
    """(reward - baseline) / std, clipped; invalid rows get 0 and are left out of all statistics.

    The std is the population's (divided by n) over the valid rows. The baseline of a row is the mean of the *other*
    valid rows (leave-one-out, Kool et al. 2019), which keeps the gradient unbiased. If ``torch.distributed`` runs, the
    rows of all workers count.

    Args:
        reward: (B,) or (B, K) floats; K columns (slots) share one baseline and one std.
        valid: (B,) or (B, K) bool; None takes all rows as valid.
        clip: largest absolute value of an advantage.
        groups: (B,) int64, such as an index of the prompt; statistics are taken within each group.

    Returns:
        float32 of the shape of ``reward``; zeros for a group with fewer than two valid entries or no spread.

    >>> compute_advantages(torch.tensor([0.0, 1.0, 5.0]), torch.tensor([True, True, False]))
    tensor([-2.,  2.,  0.])
    """
    if not clip > 0:
        raise InvalidInputError(f"advantage_clip={clip} must be positive")
    taken = torch.isfinite(reward)
    if valid is not None:
        taken = taken & (valid if valid.ndim == reward.ndim else valid[:, None])
    all_rewards, all_taken = gather_rows(reward), gather_rows(taken)
    if groups is None:
        return _normalise(reward, taken, all_rewards[all_taken], clip)
    all_groups = gather_rows(groups)
    advantage = torch.zeros_like(reward, dtype=torch.float32)
    for group in groups.unique():
        rows, in_group = groups == group, all_groups == group
        sample = all_rewards[in_group][all_taken[in_group]]
        advantage[rows] = _normalise(reward[rows], taken[rows], sample, clip)
    return advantage


def _normalise(reward: Tensor, taken: Tensor, sample: Tensor, clip: float) -> Tensor:
    """Advantages of ``reward`` against the valid rewards ``sample`` (M,)."""
    count, values = sample.numel(), sample.double()
    zeros = torch.zeros_like(reward, dtype=torch.float32)
    if count < 2 or (std := values.std(unbiased=False)) <= _MIN_STD:
        return zeros
    deviation = (torch.where(taken, reward, zeros).double() - values.mean()) / std
    deviation = deviation * (count / (count - 1))  # r - mean of the others = (r - mean of all) n / (n - 1)
    return torch.where(taken, deviation.clamp(-clip, clip).float(), zeros)
