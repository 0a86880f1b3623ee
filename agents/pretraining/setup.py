"""Initial state of a pretraining run: prior, training scenes and held-out scenes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.pretraining.initial_prior import (
    FITTED_ON,
    PROMPTS_PER_SCENE,
    GrammarStream,
    SceneTable,
    TrainingData,
    UnionTable,
    build_prior,
)
from agents.pretraining.settings import PretrainConfig
from agents.priors.files import PriorFacts
from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset, to_union
from scene_envs.datasets.dataset import union_normalizer
from scene_envs.datasets.generation import fixed_normalizer
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import register_scene_type, union_scene_type

_SAMPLE = 1024
"""Number of scenes of a grammar to which the moments and the vocabulary are fitted."""
_HELD_OUT = 512
"""Number of held-out scenes of a grammar."""


def prepare(config: PretrainConfig) -> tuple[ScenePrior, TrainingData, Tensor]:
    """The prior that a run starts from, its training scenes, and held-out scenes (K, N, D).

    A run from an older prior takes the scene type of its data; if a grammar makes the data, it takes that of the prior.
    """
    older = _older(config) if config.prior else None
    if config.data == "grammar":
        if older is not None:
            config = replace(config, scene=older.scene_type)
        grammar = get_grammar(config.scene)
        sample = grammar.sample(np.random.default_rng([config.seed, _SAMPLE]), _SAMPLE)
        reads = config.text.is_read if older is None else bool(older.text)
        prompts = describe_all(sample, np.random.default_rng(config.seed), count=PROMPTS_PER_SCENE) if reads else []
        prior = build_prior(config, sample.tensor, fixed_normalizer(grammar), prompts)
        if config.heldout:
            held_out = SceneBatch(_heldout(config.heldout, prior.scene_type.name).tensor[:2048], prior.scene_type)
        else:
            held_out = grammar.sample(np.random.default_rng([config.seed, _SAMPLE, 1]), _HELD_OUT)
        return prior, GrammarStream(grammar, prior), prior.encode(held_out)
    if "," in config.data:
        return _prepare_union(config)
    dataset = SceneDataset.load(config.data)
    name = dataset.scene_type.name
    if older is not None:
        config = replace(config, scene=name)
    elif name != _name_of(config.scene):
        raise InvalidInputError(
            f"data={config.data!r} holds scenes of {name!r}, and scene={_name_of(config.scene)}; give scene={name}"
        )
    if len(dataset) < 2:
        raise InvalidInputError(
            f"data={config.data!r} has {len(dataset)} scenes; one is held out, so give at least two"
        )
    if config.heldout:
        return prepare_from(config, dataset, _heldout(config.heldout, name))
    return prepare_from(config, *split_heldout(dataset))


def _heldout(folder: str, scene_type: str) -> SceneDataset:
    """The dataset of held-out scenes, which must be of the scene type."""
    found = SceneDataset.load(folder)
    if found.scene_type.name != scene_type:
        raise InvalidInputError(
            f"heldout={folder!r} holds scenes of {found.scene_type.name!r}, the training scenes are of {scene_type!r}"
        )
    return found


def _name_of(scene: Any) -> str:
    return str(getattr(scene, "name", scene))


def _older(config: PretrainConfig) -> PriorFacts:
    """Facts of the prior that the run starts from; raises InvalidInputError if the run needs text and it reads none."""
    older = PriorFacts.of(config.prior)
    if config.text.is_read and not older.text:
        raise InvalidInputError(
            f"text={config.text.encoder} with prior={config.prior!r}, which reads no prompts; leave text= out, or "
            "train a fresh prior"
        )
    return older


def split_heldout(dataset: SceneDataset) -> tuple[SceneDataset, SceneDataset]:
    """Training scenes, and the last 2 % (at least one), which no run trains on."""
    split = len(dataset) - max(1, len(dataset) // 50)
    return dataset[:split], dataset[split:]


def prepare_from(
    config: PretrainConfig, training: SceneDataset, heldout: SceneDataset
) -> tuple[ScenePrior, TrainingData, Tensor]:
    """The initial prior, its training scenes, and at most 2,048 held-out scenes (K, N, D), both as it encodes them."""
    prior = build_prior(config, training.tensor, training.normalizer, training.prompt_sets)

    def encode(scenes: Tensor) -> Tensor:
        return torch.cat([prior.encode(SceneBatch(part, prior.scene_type)) for part in scenes.split(10_000)])

    return prior, SceneTable(encode(training.tensor), training.prompt_sets), encode(heldout.tensor[:2048])


def _prepare_union(config: PretrainConfig) -> tuple[ScenePrior, TrainingData, Tensor]:
    if config.heldout:
        raise InvalidInputError(
            f"heldout={config.heldout!r} is not read with several datasets: 2 % of each are held out; leave it out"
        )
    whole = [SceneDataset.load(folder.strip()) for folder in config.data.split(",")]
    union = register_scene_type(union_scene_type([dataset.scene_type for dataset in whole]))
    parts = [dataset.stable_split((0.98, 0.02), seed=0) for dataset in whole]
    share = slice(min(5000, FITTED_ON // len(whole)))  # moments see scenes of every type
    some = torch.cat([to_union(dataset.batch(share), union).tensor for dataset, _ in parts])
    normalizer = union_normalizer([dataset.normalizer for dataset in whole], union)
    prompts = [prompt for dataset in whole for prompt in dataset.prompt_sets]
    prior = build_prior(replace(config, scene=union.name), some, normalizer, prompts)
    data = UnionTable([train for train, _ in parts], prior)
    heldout = torch.cat([data.encode(held.batch(slice(2048 // len(whole)))) for _, held in parts])
    return prior, data, heldout
