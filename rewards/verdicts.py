"""Cache of feasibility verdicts, so that several rewards simulate the same scene once."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.assets import Asset
    from scene_envs.physics import FeasibilityResult, PhysicsPool

_MAX_VERDICTS = 4096
"""Number of scenes whose verdicts are kept, the latest ones."""

_Verdict = tuple[Tensor, Tensor, Tensor, Tensor]
"""feasible, depth, displacement, rotation of one scene, (N,) each."""
_known: OrderedDict[bytes, _Verdict] = OrderedDict()
_assets: dict[tuple[int, ...], tuple[Asset, ...]] = {}
"""Assets whose ids are in keys; keeping them alive ensures that no other object gets their ids."""


def verdicts(batch: SceneBatch, limits: dict[str, float], pool: PhysicsPool | None) -> FeasibilityResult:
    """:func:`scene_envs.physics.feasibility` of scenes, computed only for scenes that were not judged recently.

    Scenes are recognised by their content: type, poses, categories and order of slots. A verdict depends only on its
    scene, bit for bit, so it may be kept. Verdicts of invalid scenes are not kept: a worker may only have been slow.

    Args:
        batch: B scenes of N slots.
        limits: keyword arguments of ``feasibility``.
        pool: worker processes; None computes in this process.
    """
    from scene_envs.physics import FeasibilityResult, feasibility

    keys = _keys(batch, limits)
    fresh = {key: row for row, key in enumerate(keys) if key not in _known}
    found = dict.fromkeys(keys)
    if fresh:
        rows = sorted(fresh.values())
        result = feasibility(batch if len(rows) == len(batch) else batch[rows], pool=pool, **limits)
        columns = (result.feasible, result.depth, result.displacement, result.rotation)
        for index, row in enumerate(rows):
            found[keys[row]] = (bool(result.valid[index]), tuple(column[index] for column in columns))
    judged = [found[key] or (True, _known[key]) for key in keys]
    for key, (valid, verdict) in zip(keys, judged, strict=True):
        if valid:
            _known[key] = verdict
            _known.move_to_end(key)
    while len(_known) > _MAX_VERDICTS:
        _known.popitem(last=False)
    feasible, depth, displacement, rotation = (
        torch.stack([verdict[column] for _, verdict in judged]) for column in range(4)
    )
    valid = torch.tensor([valid for valid, _ in judged], dtype=torch.bool)
    return FeasibilityResult(feasible, depth, displacement, rotation, valid, feasible.sum(dim=-1))


def forget_verdicts() -> None:
    """Clear the cache."""
    _known.clear()
    _assets.clear()


def _keys(batch: SceneBatch, limits: dict[str, float]) -> list[bytes]:
    """One digest per scene, of all inputs of its verdict."""
    assets = batch.scene_type.library.assets  # other objects once a file of a model has changed
    models = tuple(map(id, assets))
    _assets[models] = assets
    common = repr((batch.scene_type, models, sorted(limits.items()), tuple(batch.tensor.shape[1:]))).encode()
    scenes = batch.tensor.detach().cpu().contiguous().numpy()
    return [hashlib.blake2b(scene.tobytes() + common, digest_size=16).digest() for scene in scenes]
