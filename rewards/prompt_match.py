"""Reward: mean score of the claims of a prompt, from 0 to 1."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

import torch

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.datasets.prompts import ClaimCheck, PromptFacts


logger = logging.getLogger(__name__)


@register_reward("prompt_match")
@dataclass(frozen=True)
class PromptMatch:
    """Match of a scene and its prompt: mean score of the claims, from 0 to 1; 1 exactly if all hold.

    A false claim about a number scores the smaller number over the larger one; a false relation scores a quarter for
    each of its two objects that is present. The prompt is the one that the scene was made for, or ``prompt`` for all
    scenes. Scenes with an empty or unreadable prompt are invalid.

    Attributes:
        prompt: prompt to use instead of the prompts of the scenes.

    >>> reward = PromptMatch("A scene with a table and two cups.")
    >>> reward(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.5000])
    """

    name: ClassVar[str] = "prompt_match"
    maximum: ClassVar[float] = 1.0
    prompt: str | None = None

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Compare every scene with its prompt.

        Terms: ``all_claims_hold``, 1 or 0; ``claims_hold``, the share of the claims that hold.

        Raises:
            InvalidInputError: there is no prompt, there is not one per scene, or ``prompt`` cannot be read.
        """
        from scene_envs.datasets.prompts import scene_facts

        asked = claims_asked(self.name, self.prompt, batch, context.prompts)
        some = [row for row, prompt in enumerate(asked) if prompt is not None]
        facts = scene_facts(batch[some]) if some else []
        rows = torch.zeros(3, len(batch))
        for row, scene in zip(some, facts, strict=True):
            prompt = asked[row]
            assert prompt is not None
            checks = prompt.check(scene)
            held = sum(check.holds for check in checks) / len(checks)
            score = sum(check.score for check in checks) / len(checks)
            rows[:, row] = torch.tensor([score, held, float(held == 1.0)])
        value, held_share, all_hold = rows.to(batch.tensor.device)
        valid = torch.zeros(len(batch), dtype=torch.bool)
        valid[some] = True
        return RewardOutput(
            value, terms={"claims_hold": held_share, "all_claims_hold": all_hold}, valid=valid.to(batch.tensor.device)
        )


def claims_asked(
    name: str, prompt: str | None, batch: SceneBatch, prompts: Sequence[str] | None
) -> list[PromptFacts | None]:
    """Claims that a reward called ``name`` compares each scene with; None where a prompt is empty or cannot be read.
    ``prompt``, one text for all scenes, replaces ``prompts``. Raises InvalidInputError where there is no prompt, or not
    one per scene, or ``prompt`` cannot be read.
    """
    from scene_envs.datasets.prompts import parse_prompt

    if prompt is not None:
        return [parse_prompt(prompt, batch.scene_type)] * len(batch)
    if prompts is None:
        raise InvalidInputError(
            f"{name} has no prompt to compare with: give prompt= to the command or environment, or "
            f"reward='{{name: {name}, prompt: A scene with 12 objects}}'"
        )
    if len(prompts) != len(batch):
        raise InvalidInputError(f"{name}: {len(prompts)} prompts for {len(batch)} scenes; give one per scene")
    return [_claims(text, batch.scene_type) for text in prompts]


@lru_cache(maxsize=4096)
def _claims(prompt: str, scene_type: SceneType) -> PromptFacts | None:
    """The claims of a prompt, read once; None with a warning if the prompt cannot be read."""
    from scene_envs.datasets.prompts import parse_prompt

    if not prompt.strip():
        return None
    try:
        return parse_prompt(prompt, scene_type)
    except InvalidInputError as error:
        logger.warning("%s. Scenes made for this prompt count as invalid.", error)
        return None


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
    maximum: ClassVar[float] = 1.0
    prompt: str | None = None

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
