"""Fréchet distances of scenes and of their renders, and a classifier of renders."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from agents.evaluation.classifier import Accuracy, ClassifierConfig, Forward, Split, check_classes, two_sample_accuracy
from agents.evaluation.set_network import SetEncoder
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch, check_same_assets

WIDTH, HEIGHT = 96, 72
"""Default size of the renders of the classifier, pixels."""

_COLOR_FEATURES = 6


def frechet_scene_distance(a: SceneBatch, b: SceneBatch, *, encoder: SetEncoder | None = None) -> float:
    """FSD: the squared Fréchet distance of Gaussian fits to the features of a frozen set encoder.

    The formula is that of Heusel et al. (2017). The features are not those of Inception, so the distance is comparable
    only with other FSDs of the same encoder. It is biased upwards by about 1 / scenes: compare sets of equal size, and
    report the distance between two sets of real scenes of that size as well.

    Args:
        a: scenes.
        b: scenes of the same type, or of another one; categories are matched by asset name.
        encoder: encoder of the features; None takes the shipped one. The distance is in units of its whitened features.

    Raises:
        InvalidInputError: a batch has fewer than two scenes.
    """
    _check_count(len(a), len(b))
    encoder = SetEncoder.load() if encoder is None else encoder
    return feature_distance(encoder.features(a).numpy(), encoder.features(b).numpy())


def feature_distance(a: ArrayLike, b: ArrayLike) -> float:
    """Squared Fréchet distance of Gaussian fits to two sets of features, (A, F) and (B, F)."""
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1]:
        raise InvalidInputError(f"features are (scenes, F) with the same F, got {first.shape} and {second.shape}")
    _check_count(len(first), len(second))
    return gaussian_distance(
        first.mean(axis=0), np.cov(first, rowvar=False), second.mean(axis=0), np.cov(second, rowvar=False)
    )


def gaussian_distance(mean_a: ArrayLike, cov_a: ArrayLike, mean_b: ArrayLike, cov_b: ArrayLike) -> float:
    """Squared 2-Wasserstein distance of two Gaussians with means (F,) and covariances (F, F), which may be singular
    (Dowson and Landau 1982): ``|m_a - m_b|² + tr(S_a + S_b - 2 (S_a^½ S_b S_a^½)^½)``, by symmetric
    eigendecompositions.

    >>> gaussian_distance([0.0], [[1.0]], [3.0], [[4.0]])
    10.0
    """
    first, second = np.atleast_1d(np.asarray(mean_a, float)), np.atleast_1d(np.asarray(mean_b, float))
    spread_a, spread_b = np.atleast_2d(np.asarray(cov_a, float)), np.atleast_2d(np.asarray(cov_b, float))
    values, vectors = np.linalg.eigh(spread_a)
    root = (vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T
    overlap = np.sqrt(np.clip(np.linalg.eigvalsh(root @ spread_b @ root), 0.0, None)).sum()
    distance = float(((first - second) ** 2).sum() + np.trace(spread_a) + np.trace(spread_b) - 2.0 * overlap)
    return max(distance, 0.0)


def _check_count(first: int, second: int) -> None:
    if min(first, second) < 2:
        raise InvalidInputError(f"a Fréchet distance needs at least two scenes on both sides, got {first} and {second}")


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

    The renders are semantic: one class per asset, seen by the camera of the scene type. The protocol, the other
    arguments and the errors are those of :func:`~agents.evaluation.classifier.classifier_accuracy`. A render cannot
    show millimetres: at the default size a pixel of a table is about 2 cm wide.

    Args:
        real: real scenes.
        fake: samples of the same scene type.
        seeds: number of repetitions with other splits and weights.
        seed: seed of the first repetition.
        width: width of the renders in pixels, at least 16.
        height: height of the renders in pixels, at least 16.
        config: settings of the training.
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

    return two_sample_accuracy(len(real), len(fake), prepare, seeds=seeds, seed=seed, config=config)


def class_images(batches: list[SceneBatch], width: int, height: int) -> tuple[Tensor, int]:
    """(B, H, W) uint8 indices of the colours of the semantic renders of all scenes, and the number of colours."""
    from scene_envs.render import observe

    views = [observe(b, [replace(b.scene_type.camera, width=width, height=height)], ["semantic"]) for b in batches]
    images = np.concatenate([view["semantic"] for (view,) in views])
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
