"""Rewards by simulation: number or share of feasible objects, and their graded stillness."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import Checked, Positive
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.assets import Asset
    from scene_envs.physics import FeasibilityResult, PhysicsPool


_LIMITS = ("max_penetration", "max_displacement", "max_rotation", "duration")
_MAX_VERDICTS = 4096
"""Number of scenes whose verdicts are kept, the latest ones."""

_Verdict = tuple[Tensor, Tensor, Tensor, Tensor]
"""feasible, depth, displacement, rotation of one scene, (N,) each."""
_known: OrderedDict[bytes, _Verdict] = OrderedDict()
_assets: dict[tuple[int, ...], tuple[Asset, ...]] = {}
"""Assets whose ids are in keys; keeping them alive ensures that no other object gets their ids."""


def verdicts(batch: SceneBatch, limits: dict[str, float], pool: PhysicsPool | None) -> FeasibilityResult:
    """:func:`scene_envs.physics.feasibility`, with the keywords ``limits``, only of scenes that were not judged
    recently. Scenes are recognised by type, poses, categories and order of slots, on which alone a verdict depends, bit
    for bit. Verdicts of invalid scenes are not kept: a worker may only have been slow.
    """
    from scene_envs.physics import FeasibilityResult, feasibility

    keys = _keys(batch, limits)
    fresh = {key: row for row, key in enumerate(keys) if key not in _known}
    found = dict.fromkeys(keys)
    if fresh:
        rows = sorted(fresh.values())
        result = feasibility(batch if len(rows) == len(batch) else batch[rows], pool=pool, **limits)  # type: ignore[arg-type]
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


@register_reward("feasible_objects")
@dataclass(frozen=True)
class FeasibleObjects(Checked):
    """Number of free objects in the workspace that neither penetrate another object nor move when simulated.

    An object is feasible if its frame is in the workspace, it overlaps no other object by more than
    ``max_penetration`` and, with the penetrating objects removed, it moves and turns by at most the limits in
    simulation. Welded objects are not counted.

    Attributes:
        max_penetration: deepest allowed overlap with any other object, m.
        max_displacement: largest allowed movement, m.
        max_rotation: largest allowed rotation, rad.
        duration: simulated time, s.
    """

    name: ClassVar[str] = "feasible_objects"
    place = "feasible_objects: "
    max_penetration: Positive = 1e-3
    max_displacement: Positive = 1e-3
    max_rotation: Positive = 1e-2
    duration: Positive = 0.1

    def maximum(self, slots: int, free_slots: int) -> float:
        return free_slots

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count feasible objects; rows that physics could not judge are invalid.

        Terms: ``free_objects``; ``feasible_fraction`` of them (1 in a scene without free objects); ``deepest_mm``,
        the deepest overlap. ``object_flags["feasible"]`` (B, N) marks the objects that count, ``per_object`` likewise.
        """
        device = batch.tensor.device
        result = verdicts(batch, {limit: getattr(self, limit) for limit in _LIMITS}, context.pool)
        feasible = result.feasible.to(device)
        count = feasible.sum(dim=-1).float()
        free = batch.is_free.sum(dim=-1).float()
        return RewardOutput(
            value=count,
            per_object=feasible.float(),
            terms={
                "free_objects": free,
                "feasible_fraction": (count / free.clamp(min=1)).masked_fill(free == 0, 1.0),
                "deepest_mm": 1e3 * result.depth.to(device).float().amax(dim=-1),
            },
            valid=result.valid.to(device),
            object_flags={"feasible": feasible},
        )


@register_reward("feasible_share")
@dataclass(frozen=True)
class FeasibleShare(FeasibleObjects):
    """Share of the free objects that are in the workspace, overlap nothing and do not move; from 0 to 1.

    Definition and settings are those of ``feasible_objects``. A scene without free objects scores 0, so that emptying a
    scene gains nothing. Generated welded objects, such as the tables of rooms, do not change the value. They get credit
    for not overlapping each other.
    """

    name: ClassVar[str] = "feasible_share"
    averages_objects: ClassVar[bool] = True

    def maximum(self, slots: int, free_slots: int) -> float:
        return 1.0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Divide the feasible objects by the free ones; rows that physics could not judge are invalid.

        Terms: ``free_objects``, ``feasible_objects``, ``deepest_mm``. ``per_object`` (B, N) and
        ``object_flags["feasible"]`` are the verdict. ``per_object`` is also 1 for generated welded objects that
        overlap no other welded one by more than ``max_penetration``; ``object_flags["judged"]`` marks these and the
        free objects.
        """
        from scene_envs.physics import furniture_overlap

        output = FeasibleObjects.__call__(self, batch, context)
        furniture = batch.is_furniture
        apart = furniture_overlap(batch, pool=context.pool).to(furniture.device) <= self.max_penetration
        flags = {**output.object_flags, "judged": batch.is_free | furniture}
        free = output.terms["free_objects"]
        terms = {"free_objects": free, "feasible_objects": output.value, "deepest_mm": output.terms["deepest_mm"]}
        return replace(
            output,
            value=output.value / free.clamp(min=1),
            per_object=output.object_flags["feasible"].float() + (furniture & apart),
            terms=terms,
            object_flags=flags,
        )


@register_reward("stability")
@dataclass(frozen=True)
class Stability(Checked):
    """Stillness of the free objects under gravity: their mean score, from 0 to 1 (at rest).

    An object that moves by d and turns by a scores ``exp(-(d / scale + a / scale_rotation))``. Objects deeper than
    ``max_penetration`` in others are removed before the simulation, as for ``feasible_objects``, and score 0. Objects
    outside the workspace also score 0. A scene without free objects scores 0.

    Attributes:
        scale: movement that costs a factor of e, m.
        scale_rotation: rotation that costs a factor of e, rad.
        max_penetration: deepest overlap with which an object is simulated, m.
        duration: simulated time, s.
    """

    name: ClassVar[str] = "stability"
    place = "stability: "
    maximum: ClassVar[float] = 1.0
    averages_objects: ClassVar[bool] = True
    scale: Positive = 0.01
    scale_rotation: Positive = 0.1
    max_penetration: Positive = 1e-3
    duration: Positive = 0.1

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Simulate; rows that physics could not judge are invalid.

        ``per_object`` (B, N) is the score of each object. Terms: ``free_objects``; ``simulated_objects``, those that
        overlap nothing; ``moved_mm`` and ``turned_rad``, the means over these.
        """
        device = batch.tensor.device
        limits = {
            "max_penetration": self.max_penetration,
            "max_displacement": 1e-3,
            "max_rotation": 1e-2,
            "duration": self.duration,
        }  # as in feasible_objects: scenes that both rewards score are simulated once
        result = verdicts(batch, limits, context.pool)
        moved, turned = result.displacement.to(device), result.rotation.to(device)
        simulated = batch.is_free & (result.depth.to(device) <= self.max_penetration)
        score = torch.exp(-(moved / self.scale + turned / self.scale_rotation)) * (simulated & batch.in_workspace)
        free, some = batch.is_free.sum(dim=-1).float(), simulated.sum(dim=-1).float()
        return RewardOutput(
            value=score.sum(dim=-1) / free.clamp(min=1),
            per_object=score,
            terms={
                "free_objects": free,
                "simulated_objects": some,
                "moved_mm": 1e3 * (moved * simulated).sum(dim=-1) / some.clamp(min=1),
                "turned_rad": (turned * simulated).sum(dim=-1) / some.clamp(min=1),
            },
            valid=result.valid.to(device),
        )
