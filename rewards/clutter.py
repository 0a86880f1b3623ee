"""Reward: occupied share of the supporting surfaces, and of the volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.arrays import Array, Index
from scene_envs.errors import Checked, Count
from scene_envs.scene import SceneBatch, hull_corners

if TYPE_CHECKING:
    from scene_envs.datasets.prompts import SceneFacts

_PARALLEL = 1e-12


@register_reward("clutter")
@dataclass(frozen=True)
class Clutter(Checked):
    """Share of the supporting surfaces that is covered by objects, from 0 to 1.

    A surface is the top or a tier of a welded object; its area is that of the object's outline from above. Free objects
    in the workspace cover the surface that they stand on, directly or on or in other objects there. Where outlines
    overlap, the surface is covered once.

    Attributes:
        lines: number of lines along which each surface is measured; more lines are more exact.

    >>> Clutter()(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.])
    """

    name: ClassVar[str] = "clutter"
    place = "clutter: "
    maximum: ClassVar[float] = 1.0
    lines: Count = 128

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Measure covered lengths along parallel lines over each surface.

        ``per_object`` (B, N) is the share that an object covers; if several objects cover a place, it is split between
        them, so that credits add up to the value. Terms: ``covered_area`` and ``surface_area`` (m^2), and
        ``volume_share``, the volume of the free objects in the workspace over that of the workspace.
        """
        from scene_envs.datasets.prompts import scene_facts

        outlines = [corners.numpy().T for corners in hull_corners(batch.scene_type.library)]
        counted = (batch.is_free & batch.in_workspace).cpu().numpy()
        translations = batch.translations.double().cpu().numpy()
        rotations = batch.rotations.double().cpu().numpy()
        categories = batch.categories.cpu().numpy()
        covered = np.zeros(categories.shape)
        area = np.zeros(len(batch))
        for row, facts in enumerate(scene_facts(batch)):
            corners = [
                rotations[row, slot] @ outlines[categories[row, slot]] + translations[row, slot, :, None]
                for slot in facts.slots
            ]  # (3, V) each
            for support in np.flatnonzero(facts.fixed):
                surface = _Lines.over(corners[support], self.lines)
                for members in _standing(facts, int(support)):
                    area[row] += surface.area
                    members = members[counted[row, facts.slots[members]]]
                    covered[row, facts.slots[members]] += surface.shares([corners[m] for m in members])
        low, high = np.array(batch.scene_type.workspace)
        volumes = (batch.volumes * torch.from_numpy(counted).to(batch.tensor.device)).sum(dim=-1)
        credit = torch.from_numpy(covered / np.maximum(area, 1e-9)[:, None])
        return RewardOutput(
            value=_on(batch, credit.sum(dim=-1)),
            per_object=_on(batch, credit),
            terms={
                "covered_area": _on(batch, torch.from_numpy(covered.sum(axis=-1))),
                "surface_area": _on(batch, torch.from_numpy(area)),
                "volume_share": volumes / float(np.prod(high - low)),
            },
        )


@dataclass(frozen=True)
class _Lines:
    """M parallel lines over a surface, at equal distances."""

    y: Array  # (M,) positions, m
    step: float  # distance of two lines, m
    low: Array  # (M,) start of the surface along each line, m
    high: Array  # (M,) its end, m

    @classmethod
    def over(cls, corners: Array, count: int) -> _Lines:
        """``count`` lines over the outline of ``corners`` (3, V) from above."""
        bottom, top = corners[1].min(), corners[1].max()
        step = (top - bottom) / count
        y = bottom + step * (np.arange(count) + 0.5)
        return cls(y, step, *_chords(corners, y))

    @property
    def area(self) -> float:
        return float((self.high - self.low).sum()) * self.step

    def shares(self, outlines: list[Array]) -> Array:
        """(n,) m^2 of the surface under each outline (3, V); places under several outlines are split between these."""
        if not outlines:
            return np.zeros(0)
        chords = np.stack([np.stack(_chords(corners, self.y)) for corners in outlines])  # (n, 2, M)
        low, high = np.clip(chords, self.low, self.high).swapaxes(0, 1)  # (n, M) each; empty where not high > low
        cuts = np.sort(np.concatenate([low, high]), axis=0)  # (2n, M)
        middle, length = 0.5 * (cuts[1:] + cuts[:-1]), np.diff(cuts, axis=0)
        over = (low[:, None] < middle) & (middle < high[:, None])  # (n, 2n - 1, M)
        split = over * (length / np.maximum(over.sum(axis=0), 1))
        return split.sum(axis=(1, 2)) * self.step  # type: ignore[no-any-return]


def _chords(corners: Array, y: Array) -> tuple[Array, Array]:
    """(M,) start and end of lines at ``y`` (M,) within the convex outline of ``corners`` (3, V) from above. A line that
    misses the outline starts at infinity and ends at minus infinity.
    """
    from scipy.spatial import ConvexHull

    outline = corners[:2, ConvexHull(corners[:2].T).vertices]  # (2, V)
    (x0, y0), (x1, y1) = outline, np.roll(outline, -1, axis=1)
    steep = np.abs(y1 - y0) > _PARALLEL
    x0, y0, x1, y1 = x0[steep], y0[steep], x1[steep], y1[steep]
    along = (y[:, None] - y0) / (y1 - y0)  # (M, V)
    crossing = x0 + along * (x1 - x0)
    hit = (along >= 0) & (along <= 1)
    return np.where(hit, crossing, np.inf).min(axis=1), np.where(hit, crossing, -np.inf).max(axis=1)


def _standing(facts: SceneFacts, support: int) -> list[Index]:
    """Indices of the objects that stand on each surface of a welded object: on its tiers, or on its top."""
    here, tiers = facts.held.place == support, int(facts.tiers[support])
    if tiers == 0:
        return [np.flatnonzero(here)]
    return [np.flatnonzero(here & (facts.held.tier == tier)) for tier in range(tiers)]


def _on(batch: SceneBatch, values: Tensor) -> Tensor:
    return values.float().to(batch.tensor.device)
