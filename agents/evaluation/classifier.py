"""Classifier two-sample test on scene vectors with a small set transformer."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from agents.evaluation.scene_tokens import SceneTokens, blurred, scene_tokens
from agents.evaluation.set_network import SetNetwork
from agents.evaluation.two_sample_test import (
    MIN_SCENES,
    Accuracy,
    ClassifierConfig,
    Forward,
    Split,
    check_classes,
    two_sample_accuracy,
)
from agents.evaluation.typical_places import TypicalPlaces
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_distance import check_same_assets

RESOLUTION = (1e-3, 1e-2)
"""Standard deviation (m, rad) of the noise that is added to both classes: the largest motion of a feasible object."""

MAX_OBJECTS = 50_000
"""Largest number of objects to train on, both classes together; scenes of many objects cost more, and fewer suffice."""


def classifier_accuracy(
    real: SceneBatch,
    fake: SceneBatch,
    *,
    seeds: int = 10,
    seed: int = 0,
    resolution: tuple[float, float] = RESOLUTION,
    config: ClassifierConfig | None = None,
) -> Accuracy:
    """Accuracy, on held-out scenes, of a classifier trained to separate real scenes from samples.

    A set transformer reads the objects of a scene: categories, poses standardised per asset, Fourier features of the
    translation, and offsets and gaps to the nearest neighbours, standardised per pair of assets. Means and standard
    deviations are those of the real training part. Welded objects are treated like other objects; the result does not
    depend on empty slots or on the order of slots.

    Samples contain noise that grammar scenes do not have. At full precision this noise alone would identify the samples
    of every prior. Gaussian noise of the ``resolution`` is therefore added once to both classes.

    Args:
        real: real scenes; the two batches should share none.
        fake: samples of the same scene type. The larger batch is subsampled to the size of the smaller one.
        seeds: number of repetitions with other splits and weights.
        seed: seed of the first repetition.
        resolution: standard deviation of the noise (m, rad); (0, 0) compares at full precision.
        config: settings of the training and test; the classifier trains on at most 50,000 objects.

    Returns:
        Accuracy as a fraction; 0.5 is chance.

    Raises:
        InvalidInputError: the scene types differ, a batch has fewer than 20 scenes, ``seeds`` is below 1, or the
            resolution is negative.
    """
    check_same_assets(real, fake)
    if min(resolution) < 0:
        raise InvalidInputError(f"resolution is (m, rad), neither negative, got {resolution}")
    check_classes(len(real), len(fake), seeds)
    generator = torch.Generator().manual_seed(seed)
    slots = max(real.tensor.shape[1], fake.tensor.shape[1])
    both = SceneBatch(torch.cat([real.with_slots(slots).tensor, fake.with_slots(slots).tensor]).cpu(), real.scene_type)
    tokens = scene_tokens(blurred(both, *resolution, generator) if max(resolution) else both)

    width = real.scene_type.num_assets + 1

    def prepare(split: Split) -> tuple[nn.Module, Forward]:
        typical = TypicalPlaces.of(tokens[split.train[split.train < len(real)]], width)
        network = SetNetwork(typical.network_config(outputs=1))

        def forward(module: nn.Module, rows: Tensor) -> Tensor:
            logits: Tensor = module(*typical.inputs(tokens[rows]))
            return logits[:, 0]

        return network, forward

    config = _with_fewer_scenes(config or ClassifierConfig(), tokens)
    return two_sample_accuracy(len(real), len(fake), prepare, seeds=seeds, seed=seed, config=config)


def _with_fewer_scenes(config: ClassifierConfig, tokens: SceneTokens) -> ClassifierConfig:
    """``config`` with ``max_train`` lowered so that the training scenes hold about ``MAX_OBJECTS`` at most."""
    per_scene = float(tokens.present.sum()) / len(tokens)
    largest = max(MIN_SCENES, int(0.5 * MAX_OBJECTS / max(per_scene, 1.0)))
    return replace(config, max_train=min(config.max_train, largest))
