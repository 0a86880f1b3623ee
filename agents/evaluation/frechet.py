"""Fréchet distance of two sets of features, and of two sets of scenes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from agents.evaluation.set_encoder import SetEncoder
    from scene_envs.scene import SceneBatch


def frechet_scene_distance(a: SceneBatch, b: SceneBatch, *, encoder: SetEncoder | None = None) -> float:
    """FSD: the squared Fréchet distance of Gaussian fits to the features of a frozen set encoder.

    The formula is that of Heusel et al. (2017). The features are not those of Inception, so the distance is comparable
    only with other FSDs of the same encoder. It is biased upwards by about 1 / scenes: compare sets of equal size, and
    report the distance between two sets of real scenes of that size as well.

    Args:
        a: scenes.
        b: scenes of the same type, or of another one; categories are matched by asset name.
        encoder: encoder of the features; None takes the shipped one.

    Returns:
        The distance, at least 0, in units of the encoder's whitened features.

    Raises:
        InvalidInputError: a batch has fewer than two scenes.
    """
    from agents.evaluation.set_encoder import SetEncoder

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
    """Squared 2-Wasserstein distance of two Gaussians (Dowson and Landau 1982).

    ``|m_a - m_b|² + tr(S_a + S_b - 2 (S_a^½ S_b S_a^½)^½)``, by symmetric eigendecompositions, which also work for
    singular covariances.

    Args:
        mean_a: (F,) mean of the first Gaussian.
        cov_a: (F, F) covariance of the first Gaussian, symmetric and positive semi-definite.
        mean_b: (F,) mean of the second Gaussian.
        cov_b: (F, F) covariance of the second Gaussian.

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
