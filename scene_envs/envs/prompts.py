"""Prompts of the environments: their sources, and their observation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.settings import PROMPT_SOURCES
from scene_envs.errors import InvalidInputError
from scene_envs.protocols import PriorLike, PromptedPriorLike
from scene_envs.scene_types import SceneType

_BANK = 64
"""Scenes of a grammar that prompts are drawn from, with three prompts each."""
_MAX_ROWS = 4096
"""Largest number of prompts whose tokens are kept; beyond it, all of them are dropped."""


class EnvPrompts:
    """The prompts of an environment's episodes.

    Args:
        prior: Prior of the environment.
        prompt: None for no prompts; one prompt; a list to draw from; or ``"grammar"`` (or ``"data"``, which is the
            same here) for descriptions of the grammar's scenes.
        guidance: Weight w of classifier-free guidance in the prior's own steps.
        slots: Number of slots per scene; a prompt that asks for more objects is refused.

    Attributes:
        guidance: Weight of classifier-free guidance.
        given: Whether episodes have prompts.

    Raises:
        InvalidInputError: a prompt for a prior that reads none, guidance without a prompt, or a prompt that cannot be
            followed.

    >>> from scene_envs.envs.resolvers import resolve_prior
    >>> prompts = EnvPrompts(resolve_prior("dimsum_table"), ["A scene with two cups.", "A scene."], 0.0, 34)
    >>> prompts.draw(np.random.default_rng(0))
    'A scene.'
    """

    def __init__(self, prior: PriorLike, prompt: Any, guidance: float, slots: int) -> None:
        self._prior, self._slots = prior, slots
        self.guidance = float(guidance)
        self._choices: tuple[str, ...] | None = _choices(prompt)
        self.given = prompt is not None
        self._rows: dict[str, Tensor] = {}  # token indices by prompt; each is read once
        if not math.isfinite(self.guidance):
            raise InvalidInputError(f"guidance={guidance!r} must be a finite number")
        if self.guidance and (not self.given or self._choices == ("",)):
            raise InvalidInputError(
                f"guidance={self.guidance:g} strengthens a prompt, and prompt={prompt!r} asks for none; "
                "give prompt=, or leave guidance=0"
            )
        if self.given and not prior.conditional:
            raise InvalidInputError(
                f"prompt={prompt!r}: this prior of {prior.scene_type.name!r} was trained without text; "
                "leave prompt= out, or give a prior that reads prompts"
            )
        if self._choices:
            self.read(self._choices)  # raises if a prompt cannot be followed

    @property
    def reader(self) -> PromptedPriorLike | None:
        """The prior, if it reads prompts."""
        return cast(PromptedPriorLike, self._prior) if self._prior.conditional else None

    @property
    def space(self) -> tuple[int, int] | None:
        """Tokens per prompt, and size of the vocabulary; None when the prior reads no prompts."""
        return None if self.reader is None else self.reader.prompt_space

    def draw(self, rng: np.random.Generator) -> str:
        """The prompt of one episode; ``""`` without prompts. A single prompt uses no random number."""
        if not self.given:
            return ""
        choices = grammar_prompts(self._prior.scene_type, self._slots) if self._choices is None else self._choices
        return choices[0] if len(choices) == 1 else choices[int(rng.integers(len(choices)))]

    def read(self, prompts: Sequence[str]) -> Tensor:
        """Token indices (B, L) int64 of prompts, on the CPU.

        Raises:
            InvalidInputError: a prompt is too long or asks for more objects than there are slots.
        """
        if self.reader is None:
            raise InvalidInputError(f"a prior of {self._prior.scene_type.name!r} without text reads no prompts")
        new = [prompt for prompt in dict.fromkeys(prompts) if prompt not in self._rows]
        if new:
            if len(self._rows) > _MAX_ROWS:
                self._rows.clear()
                new = list(dict.fromkeys(prompts))
            self._rows |= dict(zip(new, self.reader.read_prompts(new, self._slots), strict=True))
        return torch.stack([self._rows[prompt] for prompt in prompts])


def _choices(prompt: Any) -> tuple[str, ...] | None:
    """The prompts to draw from; None for those of a grammar."""
    if prompt is None:
        return ()
    if isinstance(prompt, str):
        return None if prompt in PROMPT_SOURCES else (prompt,)
    if isinstance(prompt, Sequence) and prompt and all(isinstance(text, str) for text in prompt):
        return tuple(prompt)
    raise InvalidInputError(
        f"prompt={prompt!r} must be a text, a list of texts to draw from, one of {', '.join(PROMPT_SOURCES)}, or None"
    )


@lru_cache(maxsize=16)
def grammar_prompts(scene_type: SceneType, slots: int) -> tuple[str, ...]:
    """Descriptions of all kinds of scenes of the type's grammar; the same at every call.

    Raises:
        InvalidInputError: the grammar makes no scene of so few slots.
    """
    from scene_envs.datasets.prompts import describe_all
    from scene_envs.grammars import get_grammar

    batch = get_grammar(scene_type).sample(np.random.default_rng(0), _BANK)
    batch = batch[torch.nonzero(batch.counts <= slots).flatten()]
    if not len(batch):
        raise InvalidInputError(
            f"slots={slots}: none of {_BANK} scenes of the grammar of {scene_type.name!r} has so few objects; "
            "give prompts of your own, or more slots"
        )
    return tuple(prompt for prompts in describe_all(batch, np.random.default_rng(0)) for prompt in prompts)
