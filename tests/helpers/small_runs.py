"""Small runs on an untrained prior."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.configuration.composition import changed
from agents.evaluation import classifier
from agents.evaluation.classifier import ClassifierConfig
from agents.networks.flux_modules import ModuleConfig
from agents.post_training import PostTrainConfig
from agents.post_training import real_scenes as scene_bank
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from rewards.base import RewardContext, RewardOutput
from scene_envs.scene import SceneBatch

QUICK = ClassifierConfig(epochs=1, batch_size=16)
"""One pass: no test of a run hangs on how well the classifier of its guard learns."""
PLACES = {
    "regularisation": "regularisation.weight", "bank_size": "regularisation.bank_size",
    "real_scenes": "regularisation.scenes", "lr": "optimizer.lr", "learning_rate": "optimizer.lr",
    "chunk": "optimizer.chunk", "gradient_steps": "algorithm.gradient_steps",
    "credit": "algorithm.credit", "scenes_per_prompt": "algorithm.scenes_per_prompt",
    "guard_limit": "guard.limit", "guard_every": "guard.every", "guard_action": "guard.action",
}  # fmt: skip
"""Short names of keys of groups."""


def small_config(output: Path | str, **changes: Any) -> PostTrainConfig:
    """Four iterations in about a second; ``changes`` are keys, those of a group by one name."""
    config = PostTrainConfig(
        reward=changes.pop("reward", count_objects),
        output=str(output),
        iterations=4,
        batch_size=6,
        num_steps=3,
        algorithm={"name": "ddpo_sf", "gradient_steps": 2},
        regularisation={"weight": 1.0, "batch_size": 6, "bank_size": 24},
        guard={"scenes": 8, "every": 2},
        logger={"checkpoint_every": 2},
        progress="none",
        optimizer={"lr": 1e-3},
        **{key: changes.pop(key) for key in ("prompt", "guidance") if key in changes},
    )
    return changed(config, {PLACES.get(key, key): value for key, value in changes.items()})


def count_objects(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Objects per scene, with credit per slot."""
    return RewardOutput(batch.counts.float(), per_object=(~batch.is_empty).float())


def not_a_number(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """No valid score for any scene."""
    return RewardOutput(torch.full((len(batch),), float("nan")))


@contextmanager
def one_quick_classifier() -> Iterator[None]:
    """A figure of a guard's samples comes from one classifier of one pass, and not from the mean of three."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("agents.post_training.guard._CLASSIFIERS", 1)
        patch.setattr(classifier, "classifier_accuracy", partial(classifier.classifier_accuracy, config=QUICK))
        yield


_DRAWN: dict[tuple[Any, ...], SceneBatch] = {}


@contextmanager
def scenes_drawn_once() -> Iterator[None]:
    """The same scenes of a grammar, which take longer than an iteration, are drawn once per process."""
    draw = scene_bank.real_scenes

    def once(
        prior: ScenePrior, source: str, count: int, *, seed: int, slots: int | None = None, progress: str = "none"
    ) -> tuple[Any, Any]:
        if source != "grammar":
            return draw(prior, source, count, seed=seed, slots=slots)
        key = (prior.scene_type, prior.config.slots, count, seed, slots)
        if key not in _DRAWN:
            _DRAWN[key], _ = draw(prior, source, count, seed=seed, slots=slots)
        return SceneBatch(_DRAWN[key].tensor.clone(), prior.scene_type), None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene_bank, "real_scenes", once)
        yield


def with_modules(prior: ScenePrior, *modules: ModuleConfig) -> MixedPrior:
    """An untrained mixed prior like this one, whose network has further modules."""
    assert isinstance(prior, MixedPrior)
    network = replace(prior.config.network, modules=(*prior.config.network.modules, *modules))
    torch.manual_seed(0)
    return MixedPrior(replace(prior.config, network=network), prior.normalizer, prior.preconditioning)
