"""Crossover of two scenes: one side of a vertical plane from each."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scene_envs.scene import SceneBatch

_MIN_SHARE = 0.25
"""A cut leaves about this share, or more, of the objects of both scenes together on either side."""


def spliced(
    first: SceneBatch, second: SceneBatch, first_mask: Tensor, second_mask: Tensor, rng: np.random.Generator
) -> Tensor:
    """One scene with the objects of ``first`` on one side of a vertical plane, and those of ``second`` on the other.

    The plane has a random direction. Its place is the one at which most objects are kept. About a quarter of the
    objects of both scenes together, or more, are on either side. If there are too few slots, the objects nearest to the
    plane are left out.

    Args:
        first: a batch of one; the scene has its fixed objects.
        second: a batch of one of the same shape.
        first_mask: (N,) bool, slots of ``first`` that are left out.
        second_mask: (N,) bool, slots of ``second`` that are left out.
        rng: draws the direction.

    Returns:
        (N, D) raw scene.
    """
    fixed = torch.arange(first.tensor.shape[1]) < len(first.scene_type.fixed)
    angle = rng.uniform(0, 2 * np.pi)
    normal = torch.tensor([np.cos(angle), np.sin(angle)], dtype=torch.float32)
    rows, places = [], []
    for scene, mask in ((first, first_mask), (second, second_mask)):
        kept = ~(scene.is_empty[0] | mask | fixed)
        rows.append(scene.tensor[0, kept])
        places.append(scene.translations[0, kept, :2] @ normal)
    result = SceneBatch.empty(first.scene_type, 1, len(fixed)).tensor[0]
    result[fixed] = first.tensor[0, fixed]
    cuts = torch.cat(places).sort().values
    if not len(cuts):
        return result
    edge = int(_MIN_SHARE * (len(cuts) - 1))
    cuts = cuts[edge : len(cuts) - edge]
    gained = (places[0] >= cuts[:, None]).sum(-1) + (places[1] < cuts[:, None]).sum(-1)
    cut = cuts[gained.argmax()]
    sides = places[0] >= cut, places[1] < cut
    objects = torch.cat([part[side] for part, side in zip(rows, sides, strict=True)])
    distances = torch.cat([(place[side] - cut).abs() for place, side in zip(places, sides, strict=True)])
    objects = objects[distances.argsort(descending=True, stable=True)][: int((~fixed).sum())]
    result[len(first.scene_type.fixed) :][: len(objects)] = objects
    return result
