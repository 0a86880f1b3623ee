"""Observed parts of the scenes of a batch: where they come from, and their assignment to the episodes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Generator, Tensor

from agents.post_training.inpaint_settings import InpaintSettings
from agents.post_training.prompts import PromptSets
from agents.priors.prior import ScenePrior
from agents.utils.seeds import derived_seed
from scene_envs.envs.masks import MaskGenerator, mask_for_prompt, masked_slots, resolve_mask
from scene_envs.envs.scoring import RewardScorer, Score
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

_ROUNDS = 4
"""Most draws of scenes for a batch; all but the first replace scenes whose mask leaves nothing to regenerate."""

Source = Callable[[int, Sequence[str] | None, int], tuple[SceneBatch, Sequence[str] | None]]
"""``(count, prompts, seed) -> (scenes, prompts)``: scenes on the CPU, one per prompt if there are any."""


@dataclass(frozen=True)
class Parts:
    """One observed part per episode.

    Attributes:
        scenes: B scenes, on the CPU.
        mask: (B, N, 2) bool, True where the pose, or the category, of a slot is regenerated.
        groups: (B,) int64, equal for episodes with the same part.
        prompts: one per episode; None without prompts.
    """

    scenes: SceneBatch
    mask: Tensor
    groups: Tensor
    prompts: list[str] | None

    def take(self, rows: Tensor) -> Parts:
        """The parts of ``rows`` (K,), which may repeat."""
        prompts = None if self.prompts is None else [self.prompts[row] for row in rows.tolist()]
        return Parts(self.scenes[rows], self.mask[rows], self.groups[rows], prompts)


class InpaintDeck:
    """Deals the observed parts of batches.

    Neighbouring episodes share a part, so that they can be compared. A scene whose mask leaves nothing to regenerate is
    replaced by another one.

    Args:
        settings: settings that say which slots are regenerated.
        source: source of the scenes.
        scorer: scorer of the run's reward; masks may read its scores of the scenes.
        share: episodes of a batch that share a part.
    """

    def __init__(self, settings: InpaintSettings, source: Source, scorer: RewardScorer, share: int) -> None:
        self.settings, self.share = settings, share
        self.generator: MaskGenerator = resolve_mask(settings.mask)
        self._source, self._scorer = source, scorer

    def deal(self, count: int, prompts: Sequence[str] | None, seed: int) -> Parts:
        """The parts of ``count`` episodes, whose ``prompts`` are equal within each group; ``seed`` decides all draws.

        Raises:
            InvalidInputError: the mask leaves nothing to regenerate in any scene.
        """
        groups = max(1, count // self.share)
        of_row = torch.tensor([row * groups // count for row in range(count)])
        first = [int(torch.nonzero(of_row == group)[0]) for group in range(groups)]
        group_prompts = None if prompts is None else [prompts[row] for row in first]
        found: dict[int, Parts] = {}
        for again in range(_ROUNDS):
            for group, part in self._candidates(group_prompts, groups, derived_seed(seed, again)):
                found.setdefault(group, part)
            if len(found) == groups:
                break
        if not found:
            raise InvalidInputError(
                f"inpaint.mask={self.settings.mask!r} leaves nothing to regenerate in {_ROUNDS * groups} scenes of "
                f"inpaint.scenes={self.settings.scenes}; choose another mask, or other scenes"
            )
        some = list(found.values())
        parts = [found.get(group, some[group % len(some)]) for group in range(groups)]
        texts = None if parts[0].prompts is None else [text for part in parts for text in part.prompts or []]
        scenes = SceneBatch(torch.cat([part.scenes.tensor for part in parts]), parts[0].scenes.scene_type)
        return Parts(scenes, torch.cat([part.mask for part in parts]), torch.arange(groups), texts).take(of_row)

    def check(self, scenes: SceneBatch, prompts: Sequence[str] | None) -> None:
        """Try the mask on ``scenes``, each with its prompt if there are ``prompts``.

        Raises:
            InvalidInputError: the mask needs something that is missing, such as credit per object, or a prompt.
        """
        score = self._scorer(scenes, prompts)
        for row in range(len(scenes)):
            text = None if prompts is None else prompts[row]
            self._mask(scenes[row], score.row(row), text, np.random.default_rng(row))

    def _candidates(self, prompts: Sequence[str] | None, groups: int, seed: int) -> list[tuple[int, Parts]]:
        """Parts in which something is regenerated, each with the number of its group."""
        scenes, texts = self._source(groups, prompts, seed)
        score = self._scorer(scenes, texts)
        result = []
        for group in range(groups):
            text = None if texts is None else texts[group]
            mask = self._mask(scenes[group], score.row(group), text, np.random.default_rng([seed, group]))
            if bool(mask.any()) and bool(score.valid[group]):
                one = None if text is None else [text]
                result.append((group, Parts(scenes[group], mask[None], torch.zeros(1, dtype=torch.int64), one)))
        return result

    def _mask(self, scene: SceneBatch, score: Score, prompt: str | None, rng: np.random.Generator) -> Tensor:
        """(N, 2) bool of a batch of one; welded objects are never regenerated."""
        generator = mask_for_prompt(self.generator, prompt)
        changeable = ~scene.is_welded[0]
        changeable[: len(scene.scene_type.fixed)] = False
        slots = changeable & masked_slots(generator, scene, score, rng).to(changeable.device)
        poses_alone = self.settings.entries == "poses"
        poses = slots & scene.is_free[0] if poses_alone else slots
        return torch.stack([poses, torch.zeros_like(slots) if poses_alone else slots], dim=-1)


def real_parts(scenes: SceneBatch, slots: int, prompts: PromptSets | None = None) -> Source:
    """A source of real scenes, drawn without repetition while there are enough.

    Args:
        scenes: all of them.
        slots: per scene; scenes with objects in further slots are left out.
        prompts: prompts of a scene by its index; one of them replaces the dealt prompt. None keeps the dealt prompt.

    Raises:
        InvalidInputError: no scene fits into ``slots``.
    """
    fitting = torch.nonzero(scenes.is_empty[:, slots:].all(dim=1))[:, 0]
    if not len(fitting):
        raise InvalidInputError(
            f"none of {len(scenes)} real scenes fits into slots={slots}, so that no part of one can be observed; give "
            "more slots, or inpaint.scenes=samples"
        )

    def draw(count: int, episode_prompts: Sequence[str] | None, seed: int) -> tuple[SceneBatch, Sequence[str] | None]:
        generator = Generator().manual_seed(seed)
        rounds = [torch.randperm(len(fitting), generator=generator) for _ in range(-(-count // len(fitting)))]
        rows = fitting[torch.cat(rounds)[:count]]
        texts = episode_prompts
        if episode_prompts is not None and prompts is not None:
            sets = [prompts(row) for row in rows.tolist()]
            texts = [own[int(torch.randint(len(own), (), generator=generator))] for own in sets]
        return scenes[rows].with_slots(slots), texts

    return draw


def sampled_parts(prior: ScenePrior, num_steps: int, slots: int, guidance: float = 0.0) -> Source:
    """A source of fresh samples of ``prior``, with the weights that it has when they are drawn."""

    def draw(count: int, episode_prompts: Sequence[str] | None, seed: int) -> tuple[SceneBatch, Sequence[str] | None]:
        weight = 0.0 if episode_prompts is None else guidance
        batch = prior.sample(
            count, prompt=episode_prompts, guidance=weight, physics_guidance=0.0, num_steps=num_steps, slots=slots,
            seed=seed,
        )  # fmt: skip
        return batch.to("cpu"), episode_prompts

    return draw
