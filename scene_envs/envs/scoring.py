"""Scoring of scenes by a reward, with physics workers, for denoising and search."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from scene_envs.envs.resolvers import resolve_reward
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@dataclass(frozen=True)
class Score:
    """A reward's verdict on B scenes with N slots; every row is finite.

    Attributes:
        value: (B,) float32; 0 where ``valid`` is False.
        valid: (B,) bool.
        terms: Values (B,) float32 by name of the term; 0 where not finite.
        per_object: (B, N) float credit per slot, or None.
        object_flags: Flags (B, N) bool by name.
    """

    value: Tensor
    valid: Tensor
    terms: Mapping[str, Tensor] = field(default_factory=dict)
    per_object: Tensor | None = None
    object_flags: Mapping[str, Tensor] = field(default_factory=dict)

    def to(self, device: torch.device) -> Score:
        """The same verdict on another torch device."""
        return self._each(lambda values: values.to(device))

    def row(self, index: int) -> Score:
        """The verdict on one scene, as a batch of one."""
        return self._each(lambda values: values[index : index + 1])

    def _each(self, change: Callable[[Tensor], Tensor]) -> Score:
        return Score(
            change(self.value),
            change(self.valid),
            {name: change(term) for name, term in self.terms.items()},
            None if self.per_object is None else change(self.per_object),
            {name: change(flag) for name, flag in self.object_flags.items()},
        )


class RewardScorer:
    """Scorer of batches of scenes on the CPU, with a reward that is resolved once.

    Args:
        reward: Registered name, mapping with its settings, function or reward object.
        workers: Number of physics worker processes, started at the first scoring; 0 computes in this process, ``"ray"``
            on a Ray cluster.

    >>> scorer = RewardScorer("object_count")
    >>> scorer(SceneBatch.empty("dimsum_table", 2)).valid.tolist()
    [True, True]
    """

    def __init__(self, reward: Any, workers: int | str = 0) -> None:
        number = isinstance(workers, int) and workers >= 0
        if not number and workers != "ray":
            raise InvalidInputError(
                f"workers={workers!r}: give a number of processes, 0 for none, or ray for a Ray cluster"
            )
        self._score = resolve_reward(reward)
        self.workers = workers
        self._pool: Any = None

    def __call__(self, batch: SceneBatch, prompts: Sequence[str] | None = None) -> Score:
        """Score ``batch``, made for ``prompts`` if any; rows that cannot be scored come back invalid with value 0."""
        output = self._score(batch, prompts=None if prompts is None else tuple(prompts), pool=self._physics_pool())
        valid = output.is_valid
        value = torch.where(valid, output.value, torch.zeros_like(output.value)).float()
        terms = {name: torch.nan_to_num(term.float(), 0.0, 0.0, 0.0) for name, term in output.terms.items()}
        return Score(value, valid, terms, output.per_object, output.object_flags)

    @property
    def depends_on_batch(self) -> bool:
        """Whether the score of a scene depends on the other scenes of its batch."""
        return bool(getattr(self._score, "depends_on_batch", False))

    def maximum(self, slots: int, free_slots: int) -> float | None:
        """The largest value that the reward declares for scenes of this size, None where it declares none."""
        declared = getattr(self._score, "maximum", None)
        return None if declared is None else declared(slots, free_slots)

    def probe(self, empty: SceneBatch, prompts: Sequence[str] | None = None) -> tuple[str, ...]:
        """Names of the terms this reward reports, found by scoring one empty scene in this process."""
        output = self._score(empty, prompts=None if prompts is None else tuple(prompts))
        return tuple(sorted(output.terms))

    def _physics_pool(self) -> Any:
        if self._pool is None and self.workers != 0:
            from scene_envs.physics import make_pool

            self._pool = make_pool(self.workers)
        return self._pool

    def close(self) -> None:
        """Stop the worker processes; they start again when needed."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None
