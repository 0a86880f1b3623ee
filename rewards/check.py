"""Check of the reward contract, for the tests of reward authors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import torch
from torch import Generator, Tensor

from rewards.base import RewardContext, RewardOutput, depends_on_batch
from rewards.evaluation import evaluate_reward, other_draw
from rewards.feasible import forget_verdicts
from rewards.registry import resolve_reward, reward_name
from scene_envs.errors import RewardError, RewardTimeoutError
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

TOLERANCE = 1e-4
"""Largest difference, relative to max(1, |value|), of values that the contract requires to be equal."""

Check = Callable[["_Subject"], None]


def check_reward(
    reward: Any, scene_type: str | SceneType = "dimsum_table", *, context: RewardContext | None = None, seed: int = 0
) -> list[str]:
    """Check a reward (a name, mapping, function, class or reward) against everything that training and search rely on.

    The test scenes are drawn from ``seed``; by default the context has a prompt per scene and no worker pool.

    Returns:
        One sentence per checked clause. Scenes alone and in a batch are not compared if the reward declares
        ``depends_on_batch = True``.

    Raises:
        RewardError: the reward breaks a clause; the message has one line per broken clause. After a clause in which the
            reward took too long, no further clauses are tried.

    >>> check_reward("object_count")[0]
    'scores scenes that hold nothing but welded objects'
    """
    subject = _Subject(resolve_reward(reward), get_scene_type(scene_type), context, seed)
    checks = dict(_CHECKS)
    if depends_on_batch(subject.reward):
        del checks[_ALONE]
    failures: list[str] = []
    for title, check in checks.items():
        try:
            check(subject)
        except RewardError as error:
            failures.append(f"  {title}: no. {error}")
            if isinstance(error, RewardTimeoutError):
                break
    if failures:
        name = reward_name(subject.reward)
        raise RewardError(f"reward {name!r} breaks {len(failures)} of {len(checks)} clauses:\n" + "\n".join(failures))
    return list(checks)


class _Subject:
    """The reward under test and its test scenes."""

    def __init__(self, reward: Any, scene_type: SceneType, context: RewardContext | None, seed: int) -> None:
        self.reward = reward
        self.given_context = context
        self.generator = Generator().manual_seed(seed)
        self.empty = SceneBatch.empty(scene_type, 2)
        self.random = random_scenes(scene_type, 4, self.generator)
        self._calls = 0

    def score(self, batch: SceneBatch) -> RewardOutput:
        self._calls += 1
        forget_verdicts()  # each call must simulate anew
        context = self.given_context
        if context is None:
            counts = batch.counts.tolist()
            context = RewardContext(prompts=tuple(f"A scene with {n} object{'s' * (n != 1)}." for n in counts))
        with other_draw(self._calls):  # a reward that draws random numbers then gives another score
            return evaluate_reward(self.reward, batch, context, strict=True)

    @cached_property
    def random_output(self) -> RewardOutput:
        return self.score(self.random)


def random_scenes(scene_type: SceneType, count: int, generator: Generator) -> SceneBatch:
    """``count`` scenes of free, overlapping objects at random poses, from no slot to all slots taken."""
    fixed, slots = len(scene_type.fixed), scene_type.slots
    low, high = (torch.tensor(corner) for corner in scene_type.workspace)
    batch = SceneBatch.empty(scene_type, count)
    free = [c for c in range(scene_type.num_assets) if c not in scene_type.welded_categories]
    categories = torch.tensor(free)[torch.randint(len(free), (count, slots), generator=generator)]
    taken = fixed + (torch.linspace(0, 1, count) * (slots - fixed)).long()
    categories[torch.arange(slots) >= taken.unsqueeze(-1)] = scene_type.num_assets
    rotations = yaw_matrix(2 * torch.pi * torch.rand(count, slots, generator=generator))
    translations = low + (high - low) * torch.rand(count, slots, 3, generator=generator)
    own = batch.categories, batch.rotations, batch.translations
    for target, source in zip((categories, rotations, translations), own, strict=True):
        target[:, :fixed] = source[:, :fixed]
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def _rows_are_independent(subject: _Subject) -> None:
    for row in (0, len(subject.random) - 1):
        alone = subject.score(subject.random[row])
        _require_equal(_rows(subject.random_output, [row]), alone, f"scene {row} scored alone")


def _ignores_slot_order(subject: _Subject) -> None:
    order = torch.randperm(subject.random.tensor.shape[1], generator=subject.generator)
    shuffled = SceneBatch(subject.random.tensor[:, order], subject.random.scene_type)
    output = subject.random_output
    expected = RewardOutput(
        output.value, None if output.per_object is None else output.per_object[:, order], valid=output.valid
    )
    _require_equal(expected, subject.score(shuffled), "the same scenes with their slots shuffled")


def _ignores_empty_slots(subject: _Subject) -> None:
    slots = subject.random.tensor.shape[1]
    larger = subject.score(subject.random.with_slots(slots + 3))
    credit = None if larger.per_object is None else larger.per_object[:, :slots]
    larger = RewardOutput(larger.value, credit, valid=larger.valid)
    _require_equal(subject.random_output, larger, "the same scenes with 3 more empty slots")


_ALONE = "scores a scene the same alone and in a batch"
_CHECKS: dict[str, Check] = {
    "scores scenes that hold nothing but welded objects": lambda subject: _require_some_valid(
        subject.score(subject.empty), "scenes without free objects"
    ),
    "scores crowded scenes with overlapping objects": lambda subject: _require_some_valid(
        subject.random_output, "scenes of strewn, overlapping objects"
    ),
    "gives the same scores when called again": lambda subject: _require_equal(
        subject.random_output, subject.score(subject.random), "a second call on the same scenes"
    ),
    _ALONE: _rows_are_independent,
    "does not depend on the order of the slots": _ignores_slot_order,
    "does not depend on the number of empty slots": _ignores_empty_slots,
}


def _rows(output: RewardOutput, rows: list[int]) -> RewardOutput:
    credit = output.per_object
    return RewardOutput(output.value[rows], None if credit is None else credit[rows], valid=output.is_valid[rows])


def _require_some_valid(output: RewardOutput, what: str) -> None:
    if not bool(output.is_valid.any()):
        raise RewardError(f"Every row is invalid on {what} (values {_short(output.value)}); score at least one")


def _require_equal(expected: RewardOutput, found: RewardOutput, what: str) -> None:
    if not torch.equal(expected.is_valid, found.is_valid):
        raise RewardError(f"On {what}, valid is {found.is_valid.tolist()} instead of {expected.is_valid.tolist()}")
    valid = expected.is_valid
    value, other = expected.value[valid], found.value[valid]
    if not bool(((value - other).abs() <= TOLERANCE * value.abs().clamp(min=1.0)).all()):
        raise RewardError(f"On {what}, the values are {_short(found.value)} instead of {_short(expected.value)}")
    if (expected.per_object is None) != (found.per_object is None):
        raise RewardError(f"On {what}, per_object is given once and missing once; always give it, or never")
    if expected.per_object is not None and found.per_object is not None:
        gap = (expected.per_object - found.per_object)[valid].abs()
        if gap.numel() and not float(gap.max()) <= TOLERANCE * max(1.0, float(expected.per_object[valid].abs().max())):
            raise RewardError(f"On {what}, per_object differs by up to {float(gap.max()):.4g}")


def _short(values: Tensor) -> str:
    return "[" + ", ".join(f"{float(v):.5g}" for v in values) + "]"
