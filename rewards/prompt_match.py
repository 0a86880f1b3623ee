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
from scene_envs.envs.scoring import no_prompts
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.datasets.prompts import PromptFacts


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

    def __post_init__(self) -> None:
        if not isinstance(self.prompt, str | None):
            raise InvalidInputError(f"prompt_match: prompt={self.prompt!r} is not a text or null")

    @property
    def needs_prompts(self) -> bool:
        """Whether the prompts come with the scenes."""
        return self.prompt is None

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Compare every scene with its prompt.

        Terms: ``all_claims_hold``, 1 or 0; ``claims_hold``, the share of the claims that hold.

        Raises:
            InvalidInputError: there is no prompt, there is not one per scene, or ``prompt`` cannot be read.
        """
        from scene_envs.datasets.prompts import scene_facts

        asked = self._asked(batch, context.prompts)
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

    def _asked(self, batch: SceneBatch, prompts: Sequence[str] | None) -> list[PromptFacts | None]:
        """The claims that each scene is compared with; None where a prompt is empty or cannot be read."""
        from scene_envs.datasets.prompts import parse_prompt

        if self.prompt is not None:
            return [parse_prompt(self.prompt, batch.scene_type)] * len(batch)
        if prompts is None:
            raise InvalidInputError(no_prompts(self.name))
        if len(prompts) != len(batch):
            raise InvalidInputError(f"prompt_match: {len(prompts)} prompts for {len(batch)} scenes; give one per scene")
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
