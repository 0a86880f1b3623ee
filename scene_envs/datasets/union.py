"""Scenes of several scene types in one category space, for priors trained on all of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE, SceneBatch
from scene_envs.scene_types import SceneType


def to_union(batch: SceneBatch, union: SceneType) -> SceneBatch:
    """The same scenes in the categories of ``union``, with empty slots added up to the slots of ``union``.

    Args:
        batch: B scenes of a type whose assets ``union`` has.
        union: Result of :func:`~scene_envs.scene_types.union_scene_type`, or any scene type with those assets.

    Raises:
        InvalidInputError: an asset that ``union`` lacks.
    """
    known = {name: index for index, name in enumerate(union.assets)}
    table = torch.tensor([known.get(name, -1) for name in batch.scene_type.assets] + [union.num_assets])
    categories = table[batch.categories]
    if bool((categories < 0).any()):
        scene, slot = torch.nonzero(categories < 0)[0].tolist()
        asset = batch.scene_type.assets[int(batch.categories[scene, slot])]
        raise InvalidInputError(f"scene {scene} holds {asset!r}, which scene type {union.name!r} does not have")
    there = SceneBatch.from_parts(batch.translations, batch.rotations, categories, union)
    return there.with_slots(max(union.slots, batch.tensor.shape[1]))


def union_normalizer(normalizers: Sequence[Normalizer], union: SceneType) -> Normalizer:
    """The normalizer of ``union`` whose range covers those of all ``normalizers`` of its types.

    Poses take the widest range of any; a pose feature is constant when it is in all of them, at the same value.
    One-hots take [0, 1].
    """
    if not normalizers:
        raise InvalidInputError("a union's normalizer needs at least one normalizer, got none")
    low, high = torch.zeros(union.features), torch.ones(union.features)
    low[POSE] = torch.stack([n.input_min[POSE] for n in normalizers]).amin(dim=0)
    high[POSE] = torch.stack([n.input_max[POSE] for n in normalizers]).amax(dim=0)
    return Normalizer.from_range(low, high)
