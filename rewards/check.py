"""Check of the reward contract, for the tests of reward authors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from itertools import count
from typing import Any

import torch
from torch import Generator, Tensor

from rewards.base import RewardContext, RewardOutput, facts_of
from rewards.evaluation import evaluate_reward, other_draw
from rewards.feasible import forget_verdicts
from rewards.registry import resolve_reward, reward_name
from scene_envs.errors import RewardError, RewardTimeoutError
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

TOLERANCE = 1e-4
"""Largest difference, relative to max(1, |value|), of values that the contract requires to be equal."""

_ALONE = "scores a scene the same alone and in a batch"


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
    resolved, kind, generator = resolve_reward(reward), get_scene_type(scene_type), Generator().manual_seed(seed)
    scenes, calls = random_scenes(kind, 4, generator), count(1)
    slots = scenes.tensor.shape[1]
    order = torch.randperm(slots, generator=generator)

    def score(batch: SceneBatch) -> RewardOutput:
        forget_verdicts()  # each call must simulate anew
        prompts = tuple(f"A scene with {n} object{'s' * (n != 1)}." for n in batch.counts.tolist())
        with other_draw(next(calls)):  # a reward that draws random numbers then gives another score
            return evaluate_reward(resolved, batch, context or RewardContext(prompts=prompts), strict=True)

    expected = cache(partial(score, scenes))

    def compare(what: str, batch: SceneBatch, rows: Any = slice(None), columns: Any = slice(None)) -> None:
        """The scores of ``batch`` must be those of some of the scenes, with their slots in another order."""
        _require_equal(_part(expected(), rows, columns), _part(score(batch), slice(None), slice(slots)), what)

    def compare_alone() -> None:
        for row in (0, len(scenes) - 1):
            compare(f"scene {row} scored alone", scenes[row], [row])

    shuffled = SceneBatch(scenes.tensor[:, order], kind)
    checks: dict[str, Callable[[], None]] = {
        "scores scenes that hold nothing but welded objects": lambda: _require_some_valid(
            score(SceneBatch.empty(kind, 2)), "scenes without free objects"
        ),
        "scores crowded scenes with overlapping objects": lambda: _require_some_valid(
            expected(), "scenes of strewn, overlapping objects"
        ),
        "gives the same scores when called again": lambda: compare("a second call on the same scenes", scenes),
        _ALONE: compare_alone,
        "does not depend on the order of the slots": lambda: compare(
            "the same scenes with their slots shuffled", shuffled, columns=order
        ),
        "does not depend on the number of empty slots": lambda: compare(
            "the same scenes with 3 more empty slots", scenes.with_slots(slots + 3)
        ),
    }
    if facts_of(resolved)["depends_on_batch"]:
        del checks[_ALONE]
    failures: list[str] = []
    for title, check in checks.items():
        try:
            check()
        except RewardError as error:
            failures.append(f"  {title}: no. {error}")
            if isinstance(error, RewardTimeoutError):
                break
    if failures:
        name = reward_name(resolved)
        raise RewardError(f"reward {name!r} breaks {len(failures)} of {len(checks)} clauses:\n" + "\n".join(failures))
    return list(checks)


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


def _part(output: RewardOutput, rows: Any, columns: Any) -> RewardOutput:
    credit = output.per_object
    return RewardOutput(
        output.value[rows], None if credit is None else credit[rows][:, columns], valid=output.is_valid[rows]
    )


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
