"""Classifier two-sample test on scene vectors with a small set transformer."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.evaluation.set_network import SetNetwork, TypicalPlaces, blurred, scene_tokens
from scene_envs.errors import Checked, Count, InvalidInputError
from scene_envs.scene import SceneBatch, check_same_assets

MIN_SCENES = 20
"""Smallest number of scenes of each class with which a classifier is trained."""
RESOLUTION = (1e-3, 1e-2)
"""Standard deviation (m, rad) of the noise that is added to both classes: the largest motion of a feasible object."""
MAX_OBJECTS = 50_000
"""Largest number of objects to train on, both classes together; scenes of many objects cost more, and fewer suffice."""

_TRAIN, _VALIDATION = (0.5, 1000), (0.15, 250)
"""Share of the scenes of each class, and the largest number of them, with which a classifier is trained, and which
decide when training stops; the rest is held out."""
_LEARNING_RATE, _WEIGHT_DECAY = 4e-3, 0.02
"""Largest rate of the one-cycle schedule of AdamW, and its weight decay."""
_STOP_LOSS = 5e-3
"""Validation loss (nats) below which training stops, because the classifier separates the classes."""


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of a classifier of real scenes and samples; 0.5 is chance, 1 is always right.

    Attributes:
        mean: mean over the seeds.
        std: population standard deviation over the seeds.
        per_seed: accuracy of each seed on its held-out scenes.

    >>> Accuracy.of([0.5, 0.75])
    Accuracy(mean=0.625, std=0.125, per_seed=(0.5, 0.75))
    """

    mean: float
    std: float
    per_seed: tuple[float, ...]

    @classmethod
    def of(cls, per_seed: Sequence[float]) -> Accuracy:
        """From the accuracies of at least one seed."""
        values = torch.tensor(per_seed, dtype=torch.float64)
        return cls(float(values.mean()), float(values.std(correction=0)), tuple(per_seed))


@dataclass(frozen=True)
class ClassifierConfig(Checked):
    """Settings of the training of a classifier.

    Attributes:
        epochs: largest number of passes over the training part.
        patience: number of epochs without a better validation loss after which training stops.
        batch_size: number of scenes per step.
    """

    epochs: Count = 8
    patience: Count = 3
    batch_size: Count = 64


@dataclass(frozen=True)
class Split:
    """Rows of the training, validation and held-out parts; both classes are equally frequent in each."""

    train: Tensor
    validation: Tensor
    held_out: Tensor


Forward = Callable[[nn.Module, Tensor], Tensor]
"""From a network and rows (R,) to logits (R,)."""

Prepare = Callable[[Split], tuple[nn.Module, Forward]]
"""From a split to an untrained network and the function that reads rows; all fitting is on the training part."""


def check_classes(real: int, fake: int, seeds: int) -> None:
    """Raise InvalidInputError unless there are enough scenes of each class, and seeds."""
    if min(real, fake) < MIN_SCENES:
        raise InvalidInputError(
            f"a classifier needs at least {MIN_SCENES} real scenes and samples each, got {real} and {fake}"
        )
    if seeds < 1:
        raise InvalidInputError(f"seeds must be at least 1, got {seeds}")


def two_sample_accuracy(
    real: int, fake: int, prepare: Prepare, *, seeds: int, seed: int, config: ClassifierConfig | None,
    max_train: int = _TRAIN[1],
) -> Accuracy:  # fmt: skip
    """Train and test one classifier per seed, which ``prepare`` makes, each with a split, weights and order of its own.
    Rows 0 … real - 1 are real scenes, the following ``fake`` rows are samples. The larger class is subsampled to the
    size of the smaller one; at most ``max_train`` scenes of each class are for training.
    """
    config = config or ClassifierConfig()
    labels = torch.cat([torch.ones(real), torch.zeros(fake)])
    scores = []
    for number in range(seed, seed + seeds):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(number)
            split = _split(real, fake, max_train)
            network, forward = prepare(split)
            _train(network, forward, labels, split, config)
            right = (_logits(network, forward, split.held_out, config) > 0) == (labels[split.held_out] > 0.5)
        scores.append(float(right.double().mean()))
    return Accuracy.of(scores)


def _split(real: int, fake: int, max_train: int) -> Split:
    count = min(real, fake)
    rows = [torch.randperm(real)[:count], real + torch.randperm(fake)[:count]]
    train = min(round(_TRAIN[0] * count), max_train)
    end = train + max(1, min(round(_VALIDATION[0] * count), _VALIDATION[1]))
    parts = (slice(train), slice(train, end), slice(end, None))
    return Split(*(torch.cat([of_class[part] for of_class in rows]) for part in parts))


def _train(network: nn.Module, forward: Forward, labels: Tensor, split: Split, config: ClassifierConfig) -> None:
    """Leave the network with the weights of the epoch whose validation loss is lowest."""
    steps = math.ceil(len(split.train) / config.batch_size)
    optimizer = torch.optim.AdamW(network.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=config.epochs * steps)
    best, best_state, since = math.inf, {name: value.clone() for name, value in network.state_dict().items()}, 0
    for _ in range(config.epochs):
        network.train()
        for rows in split.train[torch.randperm(len(split.train))].split(config.batch_size):
            loss = F.binary_cross_entropy_with_logits(forward(network, rows), labels[rows])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
        logits = _logits(network, forward, split.validation, config)
        value = float(F.binary_cross_entropy_with_logits(logits, labels[split.validation]))
        since += 1
        if value < best:
            best, since = value, 0
            best_state = {name: tensor.clone() for name, tensor in network.state_dict().items()}
        if since >= config.patience or value < _STOP_LOSS:
            break
    network.load_state_dict(best_state)


@torch.no_grad()
def _logits(network: nn.Module, forward: Forward, rows: Tensor, config: ClassifierConfig) -> Tensor:
    network.eval()
    return torch.cat([forward(network, part) for part in rows.split(4 * config.batch_size)])


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
        config: settings of the training, on at most 50,000 objects.

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
    scenes = [batch.to("cpu").with_slots(slots).tensor for batch in (real, fake)]
    both = SceneBatch(torch.cat(scenes), real.scene_type)
    tokens = scene_tokens(blurred(both, *resolution, generator) if max(resolution) else both)
    width = real.scene_type.num_assets + 1

    def prepare(split: Split) -> tuple[nn.Module, Forward]:
        typical = TypicalPlaces.of(tokens[split.train[split.train < len(real)]], width)
        network = SetNetwork(typical.network_config(outputs=1))

        def forward(module: nn.Module, rows: Tensor) -> Tensor:
            logits: Tensor = module(*typical.inputs(tokens[rows]))
            return logits[:, 0]

        return network, forward

    per_scene = float(tokens.present.sum()) / len(tokens)
    most = min(_TRAIN[1], max(MIN_SCENES, int(0.5 * MAX_OBJECTS / max(per_scene, 1.0))))
    return two_sample_accuracy(len(real), len(fake), prepare, seeds=seeds, seed=seed, config=config, max_train=most)
