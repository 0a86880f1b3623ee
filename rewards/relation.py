"""Reward: mean score of the relations that a prompt claims, from 0 to 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch

from rewards.base import RewardContext, RewardOutput
from rewards.prompt_match import claims_asked
from rewards.registry import register_reward
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.datasets.prompts import ClaimCheck


@register_reward("relation")
@dataclass(frozen=True)
class Relation:
    """Match of a scene and the relations of its prompt: their mean score; 1 if all hold, or none is claimed.

    A relation gives the place of an object relative to another object or to the scene: on, in, beside, to the left,
    right, front or back. Each relation scores as in ``prompt_match``, which also scores numbers of objects. Scenes with
    an empty or unreadable prompt are invalid.

    Attributes:
        prompt: prompt to use instead of the prompts of the scenes.

    >>> reward = Relation("A scene where a cup is on top of a plate.")
    >>> output = reward(SceneBatch.empty("dimsum_table", 1), RewardContext())
    >>> output.value, output.terms["relations"]
    (tensor([0.]), tensor([1.]))
    """

    name: ClassVar[str] = "relation"
    prompt: str | None = None

    def maximum(self, slots: int, free_slots: int) -> float:
        """The largest value: every relation holds."""
        return 1.0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Compare every scene with its prompt.

        Terms: ``relations``, the number of claimed relations; ``relations_hold``, the share of them that holds (1 if
        there are none). ``per_object`` (B, N): the score of each relation is divided by the number of relations and
        shared equally among the objects in the relation.

        Raises:
            InvalidInputError: there is no prompt, there is not one per scene, or ``prompt`` cannot be read.
        """
        from scene_envs.datasets.prompts import NameCount, ObjectCount, scene_facts

        asked = claims_asked(self.name, self.prompt, batch, context.prompts)
        valid = torch.tensor([prompt is not None for prompt in asked])
        rows = torch.stack([torch.ones(len(batch)), torch.zeros(len(batch)), torch.ones(len(batch))])
        credit = torch.zeros(batch.tensor.shape[:2])
        claims = [
            [] if prompt is None else [c for c in prompt.claims if not isinstance(c, ObjectCount | NameCount)]
            for prompt in asked
        ]
        some = [row for row, relations in enumerate(claims) if relations]
        for row, scene in zip(some, scene_facts(batch[some]) if some else [], strict=True):
            checks: list[ClaimCheck] = [claim.check(scene) for claim in claims[row]]
            count = len(checks)
            held = sum(check.holds for check in checks) / count
            rows[:, row] = torch.tensor([sum(check.score for check in checks) / count, float(count), held])
            for check in checks:
                for slot in check.slots:
                    credit[row, slot] += check.score / count / len(check.slots)
        value, relations, held_share = rows.to(batch.tensor.device)
        device = batch.tensor.device
        terms = {"relations": relations, "relations_hold": held_share}
        return RewardOutput(value, credit.to(device), terms, valid.to(device))
