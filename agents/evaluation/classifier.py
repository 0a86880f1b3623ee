"""How well a small set transformer tells real scenes from samples, by their scene vectors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from agents.evaluation.judging import FEWEST, Accuracy, Forward, JudgeConfig, Split, check_classes, judge
from agents.evaluation.scene_tokens import WAVE_FEATURES, SceneTokens, blurred, scene_tokens
from agents.evaluation.set_network import SetNetwork, SetNetworkConfig
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

RESOLUTION = (1e-3, 1e-2)
"""Standard deviation (m, rad) of the noise both classes get: what a feasible object may move."""

MOST_OBJECTS = 50_000
"""Objects to train on, both classes together: scenes of many objects need fewer scenes, and cost more each."""

_PRIOR_COUNT = 4.0
"""Weight of the statistics over all categories in those of one category, in objects."""
_CLIP = 8.0


def classifier_accuracy(
    real: SceneBatch,
    fake: SceneBatch,
    *,
    seeds: int = 10,
    seed: int = 0,
    resolution: tuple[float, float] = RESOLUTION,
    config: JudgeConfig | None = None,
) -> Accuracy:
    """Accuracy, on held-out scenes, of a classifier trained to tell real scenes from samples.

    A set transformer on the objects of a scene: categories, poses standardised per category by the real training
    part, Fourier features of the translation, and the gaps to the nearest neighbours. Welded objects are objects
    like any other; empty slots and the order of slots mean nothing.

    Samples carry noise that no grammar has, so that at full float precision every sampler is told apart by it and
    the accuracy says nothing. Both classes therefore get Gaussian noise of the ``resolution``, once.

    Args:
        real: real scenes; the two batches should share none.
        fake: samples of the same scene type. Of the larger batch as many as the smaller has are drawn.
        seeds: repetitions with other splits and weights.
        seed: the first of them.
        resolution: standard deviation of the noise (m, rad); (0, 0) judges at full precision.
        config: sizes of the parts, and how the classifier is trained; it trains on at most 50,000 objects.

    Returns:
        Accuracy as a fraction: 0.5 when nothing tells them apart.

    Raises:
        InvalidInputError: other scene types, fewer than 20 scenes in one batch, no seeds, a negative resolution.
    """
    if real.scene_type.assets != fake.scene_type.assets:
        raise InvalidInputError(
            f"a classifier needs scenes of one type, got {real.scene_type.name!r} and {fake.scene_type.name!r}"
        )
    if min(resolution) < 0:
        raise InvalidInputError(f"resolution is (m, rad), neither negative, got {resolution}")
    check_classes(len(real), len(fake), seeds)
    generator = torch.Generator().manual_seed(seed)
    slots = max(real.tensor.shape[1], fake.tensor.shape[1])
    both = SceneBatch(torch.cat([real.with_slots(slots).tensor, fake.with_slots(slots).tensor]).cpu(), real.scene_type)
    tokens = scene_tokens(blurred(both, *resolution, generator) if max(resolution) else both)

    def prepare(split: Split) -> tuple[nn.Module, Forward]:
        standardise = _Standardisation.fit(tokens[split.train[split.train < len(real)]], real.scene_type.num_assets)
        network = SetNetwork(SetNetworkConfig(12 + WAVE_FEATURES, real.scene_type.num_assets + 1, outputs=1))

        def forward(module: nn.Module, rows: Tensor) -> Tensor:
            part = tokens[rows]
            own = torch.cat([standardise(part), part.waves], dim=-1)
            logits: Tensor = module(own, part.categories, part.offsets, part.neighbours, part.present)
            return logits[:, 0]

        return network, forward

    return judge(
        len(real), len(fake), prepare, seeds=seeds, seed=seed, config=_affordable(config or JudgeConfig(), tokens)
    )


def _affordable(config: JudgeConfig, tokens: SceneTokens) -> JudgeConfig:
    """The protocol with so few training scenes that they hold no more than ``MOST_OBJECTS``."""
    per_scene = float(tokens.present.sum()) / len(tokens)
    most = max(FEWEST, int(0.5 * MOST_OBJECTS / max(per_scene, 1.0)))
    return replace(config, most_train=min(config.most_train, most))


class _Standardisation:
    """Mean and standard deviation of poses per category, (C + 1, 12) each."""

    def __init__(self, mean: Tensor, std: Tensor) -> None:
        self.mean, self.std = mean, std

    @classmethod
    def fit(cls, tokens: SceneTokens, categories: int) -> _Standardisation:
        """From the objects of real scenes; rare categories lean on the variance of all of them."""
        poses, names = tokens.poses[tokens.present].double(), tokens.categories[tokens.present]
        count = torch.bincount(names, minlength=categories + 1)[:, None].double()
        mean = torch.zeros(categories + 1, 12, dtype=torch.float64).index_add(0, names, poses) / count.clamp(min=1.0)
        squares = torch.zeros_like(mean).index_add(0, names, (poses - mean[names]) ** 2)
        overall = squares.sum(dim=0) / count.sum().clamp(min=1.0)
        variance = (squares + _PRIOR_COUNT * overall) / (count + _PRIOR_COUNT)
        return cls(mean.float(), variance.sqrt().clamp(min=1e-4).float())

    def __call__(self, tokens: SceneTokens) -> Tensor:
        """(B, N, 12) standardised poses."""
        scaled = (tokens.poses - self.mean[tokens.categories]) / self.std[tokens.categories]
        return scaled.clamp(-_CLIP, _CLIP)
