"""Training scenes: datasets in memory, of one or several scene types, or an endless grammar stream."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Generator, Tensor

from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset, to_union
from scene_envs.datasets.prompts import describe_all
from scene_envs.grammars import Grammar
from scene_envs.scene import SceneBatch

PROMPTS_PER_SCENE = 3


class TrainingData(Protocol):
    """Training scenes; a draw depends only on the generator, so that a run can be resumed at any step."""

    @property
    def size(self) -> int:
        """Number of distinct scenes; 0 for an endless stream."""

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """(count, N, D) encoded scenes, and the prompts of each if ``prompts`` is True."""


class SceneTable:
    """Scenes in memory, drawn with replacement.

    Args:
        scenes: (M, N, D) scenes as the prior encodes them.
        prompts: prompts of every scene; may be empty if draws need no prompts.
    """

    def __init__(self, scenes: Tensor, prompts: Sequence[Sequence[str]] = ()) -> None:
        self.scenes = scenes
        self.prompts = prompts

    @property
    def size(self) -> int:
        """Number of scenes, M."""
        return len(self.scenes)

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        index = torch.randint(len(self.scenes), (count,), generator=generator)
        return self.scenes[index], [self.prompts[i] for i in index.tolist()] if prompts else []


class UnionTable:
    """Scenes of several types in memory, as scenes of their union; each type is as likely as the others.

    Args:
        datasets: one dataset per scene type.
        prior: prior of the union, which encodes the drawn scenes.
    """

    def __init__(self, datasets: Sequence[SceneDataset], prior: ScenePrior) -> None:
        self.datasets = datasets
        self.prior = prior

    @property
    def size(self) -> int:
        """Number of scenes of all types."""
        return sum(len(dataset) for dataset in self.datasets)

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        chosen = torch.randint(len(self.datasets), (count,), generator=generator)
        places = torch.rand(count, generator=generator)
        scenes = torch.empty(count, self.prior.scene_type.slots, self.prior.features)
        texts: list[Sequence[str]] = [()] * count
        for number, dataset in enumerate(self.datasets):
            rows = torch.nonzero(chosen == number).flatten()
            index = (places[rows] * len(dataset)).long()
            if len(rows):
                scenes[rows] = self.encode(dataset.batch(index))
            for row, i in zip(rows.tolist(), index.tolist(), strict=True):
                texts[row] = dataset.prompt_sets[i]
        return scenes, texts if prompts else []

    def encode(self, batch: SceneBatch) -> Tensor:
        """Scenes of one type as the prior of the union encodes them."""
        union = to_union(batch, self.prior.scene_type)
        return self.prior.encode(union.to(self.prior.device)).cpu()


class GrammarStream:
    """Endless fresh scenes of a grammar, not verified by physics.

    Args:
        grammar: grammar of the scenes.
        prior: prior that encodes the scenes.
    """

    def __init__(self, grammar: Grammar, prior: ScenePrior) -> None:
        self.grammar = grammar
        self.prior = prior

    @property
    def size(self) -> int:
        """0, because the stream is endless."""
        return 0

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        seeds = torch.randint(2**62, (2,), generator=generator).tolist()
        raw = torch.from_numpy(self.grammar.sample_array(np.random.default_rng(seeds[0]), count))
        batch = SceneBatch(raw, self.prior.scene_type)
        texts = describe_all(batch, np.random.default_rng(seeds[1]), count=PROMPTS_PER_SCENE) if prompts else []
        return self.prior.encode(batch.to(self.prior.device)).cpu(), list(texts)
