"""Scenes of given objects, for figures that are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

DIMSUM = get_scene_type("dimsum_table")


def build(*scenes: Sequence[tuple[str, float, float, float]], scene_type: str = "dimsum_table") -> SceneBatch:
    """Scenes from (asset, x, y, z) lists, m; the fixed objects of the type come first."""
    batch = SceneBatch.empty(scene_type, len(scenes))
    kind, first = batch.scene_type, len(batch.scene_type.fixed)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories
    for row, objects in enumerate(scenes):
        for slot, (name, *position) in enumerate(objects, start=first):
            translations[row, slot] = torch.tensor(position)
            rotations[row, slot] = torch.eye(3)
            categories[row, slot] = kind.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, kind)
