"""Prompts of a post-training run and their assignment to the scenes of a batch."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Generator

from agents.priors.prior import ScenePrior
from scene_envs.datasets.prompts import describe_all
from scene_envs.envs.prompts import grammar_prompts
from scene_envs.files import write_text
from scene_envs.scene import SceneBatch

PROMPTS_NAME = "real_prompts.json"
_PER_SCENE = 3

PromptSets = Callable[[int], Sequence[str]]
"""All prompts of a real scene, by its index."""


class GrammarPrompts:
    """Descriptions of scenes without prompts, written on first use.

    Args:
        batch: scenes to describe.
        seed: seed of the descriptions; those of scene i depend only on the seed and on i.
    """

    def __init__(self, batch: SceneBatch, seed: int) -> None:
        self.batch, self.seed = batch, seed
        self._written: dict[int, tuple[str, ...]] = {}

    def __call__(self, index: int) -> Sequence[str]:
        """All prompts of scene ``index``."""
        if index not in self._written:
            rng = np.random.default_rng([self.seed, index])
            (self._written[index],) = describe_all(self.batch[index], rng, count=_PER_SCENE)
        return self._written[index]


class PromptDeck:
    """Deck from which the prompts of batches are dealt.

    Args:
        prompt: one text, a list, ``"data"`` (the prompts of real scenes) or ``"grammar"``.
        share: number of scenes of a batch that share a prompt, so that they can be compared.
        real: prompts of real scenes by index, for ``"data"``.
        count: number of real scenes.

    >>> deck = PromptDeck(["A scene with two cups.", "A scene with a teapot."], share=2)
    >>> dealt = deck.deal(4, Generator().manual_seed(0))
    >>> dealt[0] == dealt[1] != dealt[2] == dealt[3]
    True
    """

    def __init__(self, prompt: Any, share: int, real: PromptSets | None = None, count: int = 0) -> None:
        self.share = share
        self._real, self._count = real, count
        self._texts: tuple[str, ...] = (
            () if prompt == "data" else (prompt,) if isinstance(prompt, str) else tuple(prompt)
        )

    @classmethod
    def of(cls, prior: ScenePrior, prompt: Any, share: int, slots: int, real: PromptSets, count: int) -> PromptDeck:
        """The deck of a run; ``"grammar"`` is replaced by descriptions of grammar scenes that fit into ``slots``."""
        if prompt == "grammar":
            prompt = grammar_prompts(prior.scene_type, slots)
        return cls(prompt, share, real, count)

    def deal(self, count: int, generator: Generator) -> list[str]:
        """``count`` prompts; neighbours share a prompt, in groups of ``share`` or a few more."""
        groups = max(1, count // self.share)
        different = [self._text(index, generator) for index in self._indices(groups, generator)]
        return [different[row * groups // count] for row in range(count)]

    def _indices(self, groups: int, generator: Generator) -> list[int]:
        """Indices of prompts, without repetition while there are enough."""
        size = len(self._texts) or self._count
        rounds = [torch.randperm(size, generator=generator) for _ in range(-(-groups // size))]
        return torch.cat(rounds)[:groups].tolist()  # type: ignore[no-any-return]

    def _text(self, index: int, generator: Generator) -> str:
        if self._texts or self._real is None:
            return self._texts[index]
        texts = self._real(index)
        return texts[int(torch.randint(len(texts), (), generator=generator))]


def prompts_beside(directory: Path, batch: SceneBatch, seed: int) -> PromptSets:
    """The prompts of a run's real scenes: those kept in the run's folder, or else descriptions of the scenes."""
    path = directory / PROMPTS_NAME
    return load_prompts(path) if path.exists() else GrammarPrompts(batch, seed)


def save_prompts(path: Path, prompts: Sequence[Sequence[str]]) -> None:
    """Write the prompts of a dataset's scenes to ``path``, as JSON."""
    write_text(path, json.dumps([list(texts) for texts in prompts]) + "\n")


def load_prompts(path: Path) -> PromptSets:
    """Inverse of :func:`save_prompts`."""
    prompts: list[list[str]] = json.loads(path.read_text(encoding="utf-8"))
    return prompts.__getitem__
