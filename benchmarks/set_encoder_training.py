"""Training of the set encoder: self-supervised, on grammar scenes of all types."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.evaluation.set_network import FEATURES, SetEncoder, blurred, scene_tokens
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

_LOGGER = logging.getLogger(__name__)

ENCODED_TYPES = (
    "breakfast_table_high_clutter",
    "breakfast_table_low_clutter",
    "dimsum_table",
    "living_room_shelf",
    "pantry_shelf",
    "restaurant_high_clutter",
    "restaurant_low_clutter",
)
"""Scene types the shipped encoder was trained on; their assets are its vocabulary."""

DAMAGES = 5
"""Kinds of damage: position noise, rotation noise, swapped assets, moved objects, removed objects."""

_UNKNOWN_SHARE = 0.1
_LEAST_VARIANCE = 0.05
"""Share of the largest variance; directions of the features with a smaller variance are not scaled up to variance 1."""
_TEMPERATURE = 0.2


@dataclass(frozen=True)
class SetEncoderTraining:
    """Length, data and losses of a training.

    Attributes:
        scenes: grammar scenes per scene type.
        steps: optimiser steps; the scene types take turns.
        batch_size: scenes per step.
        learning_rate: largest rate of the one-cycle schedule of AdamW.
        contrast_weight: weight of the contrastive loss.
        content_weight: weight of the loss on asset counts.
    """

    scenes: int = 160
    steps: int = 1050
    batch_size: int = 16
    learning_rate: float = 2e-3
    contrast_weight: float = 0.2
    content_weight: float = 0.5


def train_set_encoder(
    seed: int = 0,
    config: SetEncoderTraining | None = None,
    *,
    scene_types: Sequence[str | SceneType] = ENCODED_TYPES,
    scenes: Mapping[str, SceneBatch] | None = None,
) -> SetEncoder:
    """Train an encoder on grammar scenes; with the defaults, the shipped one.

    One feature vector serves three tasks. The first is to predict how much a scene was damaged, and how (five numbers,
    squared error). The second is to predict how many objects of each asset the scene holds (squared error of log
    counts). The third is to find, for half of the objects of a scene, the other half among the scenes of a batch
    (InfoNCE). A share of the assets is shown without names.

    Args:
        seed: of the grammars, the weights and the damage; the same seed gives the same weights on one machine with
            one thread.
        config: how long; None takes the defaults.
        scene_types: what to train on.
        scenes: real scenes by scene type, instead of drawing them from the grammars.

    Returns:
        The encoder, with features whitened over clean and damaged scenes.
    """
    config = config or SetEncoderTraining()
    types = [get_scene_type(name) for name in scene_types]
    if not types:
        raise InvalidInputError("an encoder needs at least one scene type, got none")
    pools = [_pool(scene_type, config.scenes, seed, scenes) for scene_type in types]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder = SetEncoder(sorted({asset for scene_type in types for asset in scene_type.assets}))
        _train(encoder, pools, config)
        whiten(encoder, pools)
    return encoder.eval().requires_grad_(False)


def damage(batch: SceneBatch, generator: torch.Generator) -> tuple[SceneBatch, Tensor]:
    """Damage the free objects of each scene at random, each kind in some scenes only.

    Args:
        batch: B scenes.
        generator: of the damage.

    Returns:
        The damaged scenes, and how much (B, 5), 0 for not at all: log(1 + σ / 1 mm) of the position noise,
        log(1 + σ / 0.01 rad) of the rotation noise, and four times the shares swapped, moved by up to 0.3 m, and
        removed.
    """
    count, free = len(batch), batch.is_free

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    some = uniform(count, DAMAGES) < torch.tensor([0.5, 0.3, 0.3, 0.3, 0.3])
    position = torch.where(some[:, 0], 1e-3 * 100.0 ** uniform(count), 0.0)
    rotation = torch.where(some[:, 1], 1e-2 * 50.0 ** uniform(count), 0.0)
    shares = 0.6 * uniform(count, 3) * some[:, 2:]
    swapped, moved, removed = ((uniform(*free.shape) < shares[:, i, None]) & free for i in range(3))
    on_free = free[..., None].float()
    noisy = blurred(batch, position[:, None, None] * on_free, rotation[:, None, None] * on_free, generator)
    offset = 0.6 * (uniform(*free.shape, 3) - 0.5) * torch.tensor([1.0, 1.0, 0.2]) * moved[..., None]
    candidates = [c for c in range(batch.scene_type.num_assets) if c not in batch.scene_type.welded_categories]
    other = torch.tensor(candidates)[torch.randint(len(candidates), free.shape, generator=generator)]
    categories = torch.where(swapped, other, batch.categories)
    categories = categories.masked_fill(removed, batch.scene_type.num_assets)
    damaged = SceneBatch.from_parts(noisy.translations + offset, noisy.rotations, categories, batch.scene_type)
    total = free.sum(dim=1).clamp(min=1)
    amounts = [(position / 1e-3).log1p(), (rotation / 1e-2).log1p()]
    amounts += [4.0 * hit.sum(dim=1) / total for hit in (swapped, moved, removed)]
    return damaged, torch.stack(amounts, dim=-1)


def _pool(scene_type: SceneType, count: int, seed: int, scenes: Mapping[str, SceneBatch] | None) -> SceneBatch:
    from scene_envs.grammars import get_grammar

    if scenes is not None:
        return scenes[scene_type.name][:count]
    return get_grammar(scene_type).sample(np.random.default_rng(seed), count)


def _train(encoder: SetEncoder, pools: Sequence[SceneBatch], config: SetEncoderTraining) -> None:
    generator = torch.Generator().manual_seed(int(torch.randint(2**31, ())))
    heads = nn.ModuleDict(
        {
            "damage": nn.Linear(FEATURES, DAMAGES),
            "content": nn.Linear(FEATURES, len(encoder.vocabulary)),
            "contrast": nn.Linear(FEATURES, FEATURES),
        }
    )
    parameters = [*encoder.parameters(), *heads.parameters()]
    optimizer = torch.optim.AdamW(parameters, config.learning_rate, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=config.steps)
    encoder.train()
    for step in range(config.steps):
        pool = pools[step % len(pools)]
        clean = _trimmed(pool[torch.randint(len(pool), (config.batch_size,), generator=generator)])
        names = _some_unknown(encoder, clean, generator)
        damaged, amounts = damage(clean, generator)
        features = encoder(scene_tokens(damaged), names)
        damage_loss = F.mse_loss(heads["damage"](features), amounts)
        content_loss = F.mse_loss(heads["content"](features), _log_counts(encoder, damaged))
        halves = [encoder(scene_tokens(half), names) for half in _halves(clean, generator)]
        first, second = (F.normalize(heads["contrast"](half), dim=-1) for half in halves)
        similarity = first @ second.T / _TEMPERATURE
        target = torch.arange(len(clean))
        contrast_loss = 0.5 * (F.cross_entropy(similarity, target) + F.cross_entropy(similarity.T, target))
        loss = damage_loss + config.content_weight * content_loss + config.contrast_weight * contrast_loss
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        if step % 35 < len(pools):
            parts = ", ".join(
                f"{name} {float(value.detach()):.3f}"
                for name, value in (("damage", damage_loss), ("content", content_loss), ("contrast", contrast_loss))
            )
            _LOGGER.info("set encoder, step %d of %d: %s", step, config.steps, parts)


@torch.no_grad()
def whiten(encoder: SetEncoder, pools: Sequence[SceneBatch]) -> None:
    """Whiten the features over clean and damaged scenes, within each type.

    Without whitening, several features that respond to the same damage would each count it, and one kind of damage
    would dominate the distance.

    Args:
        encoder: its mean and whitening are set.
        pools: scenes of each type; all types weigh the same when they are of equal size.
    """
    generator = torch.Generator().manual_seed(0)
    encoder.eval()
    parts = []
    for clean in pools:
        both = SceneBatch.concatenate([clean, damage(clean, generator)[0]])
        parts.append(encoder(scene_tokens(both), encoder.names(both)).double())
    within = torch.cat([part - part.mean(dim=0) for part in parts])
    values, vectors = torch.linalg.eigh(within.T @ within / (len(within) - len(parts)))
    encoder.mean.copy_(torch.cat(parts).mean(dim=0))
    encoder.whitening.copy_(vectors * values.clamp(min=_LEAST_VARIANCE * values.max()).rsqrt() @ vectors.T)


def _some_unknown(encoder: SetEncoder, batch: SceneBatch, generator: torch.Generator) -> Tensor:
    """The tokens of the categories, a share of them hidden."""
    names = encoder.names(batch)
    hidden = torch.rand(names.shape, generator=generator) < _UNKNOWN_SHARE
    hidden[-1] = False
    return names.masked_fill(hidden, encoder.unknown)


def _halves(batch: SceneBatch, generator: torch.Generator) -> tuple[SceneBatch, SceneBatch]:
    """The free objects of each scene dealt into two, slightly moved; both keep the welded ones."""
    first = torch.rand(batch.is_free.shape, generator=generator) < 0.5
    empty, halves = batch.scene_type.num_assets, []
    for kept in (first, ~first):
        categories = batch.categories.masked_fill(batch.is_free & ~kept, empty)
        half = SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type)
        halves.append(blurred(half, 2e-3, 2e-2, generator))
    return halves[0], halves[1]


def _log_counts(encoder: SetEncoder, batch: SceneBatch) -> Tensor:
    """(B, V) log(1 + objects) of each asset of the vocabulary."""
    counts = torch.zeros(len(batch), len(encoder.vocabulary) + 2)
    names = encoder.names(batch)[batch.categories]
    counts.scatter_add_(1, names, torch.ones(names.shape))
    return counts[:, : len(encoder.vocabulary)].log1p()


def _trimmed(batch: SceneBatch) -> SceneBatch:
    """The same scenes without slots that are empty in all of them."""
    used = torch.nonzero((~batch.is_empty).any(dim=0))
    return batch.with_slots(int(used.max()) + 1 if len(used) else 1)
