"""Classifier two-sample test on semantic renders with a small CNN."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

from agents.evaluation.two_sample_test import (
    Accuracy,
    ClassifierConfig,
    Forward,
    Split,
    check_classes,
    two_sample_accuracy,
)
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_distance import check_same_assets

WIDTH, HEIGHT = 96, 72
"""Default size of the renders, pixels."""

_COLOR_FEATURES = 6


def render_classifier_accuracy(
    real: SceneBatch,
    fake: SceneBatch,
    *,
    seeds: int = 10,
    seed: int = 0,
    width: int = WIDTH,
    height: int = HEIGHT,
    config: ClassifierConfig | None = None,
) -> Accuracy:
    """Accuracy, on held-out scenes, of a CNN trained to separate renders of real scenes from renders of samples.

    The renders are semantic: one class per asset, seen by the camera of the scene type. The protocol is that of
    :func:`~agents.evaluation.classifier.classifier_accuracy`. A render cannot show millimetres: at the default size a
    pixel of a table is about 2 cm wide.

    Args:
        real: real scenes; the two batches should share none.
        fake: samples of the same scene type. The larger batch is subsampled to the size of the smaller one.
        seeds: number of repetitions with other splits and weights.
        seed: seed of the first repetition.
        width: width of the renders in pixels, at least 16.
        height: height of the renders in pixels, at least 16.
        config: settings of the training and test.

    Returns:
        Accuracy as a fraction; 0.5 is chance.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        InvalidInputError: the scene types differ, a batch has fewer than 20 scenes, ``seeds`` is below 1, or a side of
            the renders is below 16 pixels.
    """
    check_same_assets(real, fake)
    if min(width, height) < 16:
        raise InvalidInputError(f"renders need at least 16 x 16 pixels, got width={width}, height={height}")
    check_classes(len(real), len(fake), seeds)
    images, colors = class_images([real, fake], width, height)

    def prepare(split: Split) -> tuple[nn.Module, Forward]:
        def forward(network: nn.Module, rows: Tensor) -> Tensor:
            return network(images[rows].long())

        return _RenderNetwork(colors), forward

    config = config or ClassifierConfig()
    return two_sample_accuracy(len(real), len(fake), prepare, seeds=seeds, seed=seed, config=config)


def class_images(batches: list[SceneBatch], width: int, height: int) -> tuple[Tensor, int]:
    """Semantic renders as class indices.

    Args:
        batches: scenes of one type.
        width: width of the renders in pixels.
        height: height of the renders in pixels.

    Returns:
        (B, H, W) uint8 indices of the colours of all renders, and the number of colours.
    """
    from scene_envs.render import render

    images = np.concatenate([render(b, style="semantic", width=width, height=height) for b in batches])
    red, green, blue = np.moveaxis(images.astype(np.int32), -1, 0)
    colors, index = np.unique((red << 16) | (green << 8) | blue, return_inverse=True)
    return torch.from_numpy(index.reshape(images.shape[:-1]).astype(np.uint8)), len(colors)


class _RenderNetwork(nn.Module):
    """Class images (B, H, W) to logits (B,): three strided convolutions, average and maximum over the image."""

    def __init__(self, colors: int) -> None:
        super().__init__()
        self.color = nn.Embedding(colors, _COLOR_FEATURES)
        widths = (_COLOR_FEATURES, 16, 24, 32)
        layers: list[nn.Module] = []
        for fan_in, fan_out in pairwise(widths):
            layers += [nn.Conv2d(fan_in, fan_out, 3, stride=2, padding=1), nn.GroupNorm(4, fan_out), nn.GELU()]
        self.trunk = nn.Sequential(*layers)
        self.coarse = nn.AdaptiveAvgPool2d((3, 4))
        self.head = nn.Sequential(nn.Dropout(0.2), nn.Linear(32 * 14, 32), nn.GELU(), nn.Linear(32, 1))

    def forward(self, images: Tensor) -> Tensor:
        features = self.trunk(self.color(images).permute(0, 3, 1, 2).contiguous())
        summary = [self.coarse(features).flatten(1), features.mean(dim=(2, 3)), features.amax(dim=(2, 3))]
        logits: Tensor = self.head(torch.cat(summary, dim=1))
        return logits[:, 0]
