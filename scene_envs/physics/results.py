"""Results of the physics functions."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from scene_envs.scene import SceneBatch


@dataclass(frozen=True)
class FeasibilityResult:
    """The verdict per object.

    Attributes:
        feasible: (B, N) bool; free objects that pass. Welded and empty slots are False.
        depth: (B, N) m, deepest overlap of each object with any other, welded ones included.
        displacement: (B, N) m, how far the object frame moved; 0 where the object was not simulated.
        rotation: (B, N) rad, the angle it turned.
        valid: (B,) bool; False where physics could not judge the scene. All other fields are 0 there.
        counts: (B,) int64, feasible objects per scene.
    """

    feasible: Tensor
    depth: Tensor
    displacement: Tensor
    rotation: Tensor
    valid: Tensor
    counts: Tensor


@dataclass(frozen=True)
class ObjectPair:
    """Two overlapping objects of one scene.

    Attributes:
        slots: their slots.
        depth: deepest overlap of any two of their convex parts, m.
        total: sum over all overlapping pairs of convex parts, m.
        part_pairs: how many pairs of convex parts overlap.
    """

    slots: tuple[int, int]
    depth: float
    total: float
    part_pairs: int


@dataclass(frozen=True)
class PenetrationResult:
    """Overlap between objects; pairs of welded objects do not count.

    Attributes:
        pairs: per scene, the overlapping object pairs in slot order.
        depth: (B, N) m, deepest overlap of each object.
        total_per_pair: (B,) m, the sum over object pairs of their depth.
        total_per_geometry: (B,) m, the sum over all pairs of convex parts (the literature's measure).
        valid: (B,) bool.
    """

    pairs: tuple[tuple[ObjectPair, ...], ...]
    depth: Tensor
    total_per_pair: Tensor
    total_per_geometry: Tensor
    valid: Tensor


@dataclass(frozen=True)
class EquilibriumResult:
    """Motion under gravity.

    Attributes:
        displacement: (B, N) m.
        rotation: (B, N) rad.
        valid: (B,) bool.
    """

    displacement: Tensor
    rotation: Tensor
    valid: Tensor


@dataclass(frozen=True)
class SettleResult:
    """Scenes after they came to rest.

    Attributes:
        batch: the scenes at their new poses; invalid rows as they were.
        displacement: (B, N) m, from the given poses.
        rotation: (B, N) rad.
        finished: (B,) bool; False where the scene's work budget was spent first: objects are at the poses reached, and
            may be moving. False also where ``valid`` is False.
        valid: (B,) bool.
    """

    batch: SceneBatch
    displacement: Tensor
    rotation: Tensor
    finished: Tensor
    valid: Tensor


@dataclass(frozen=True)
class ProjectionResult:
    """Scenes moved to the nearest translations without overlap.

    Attributes:
        batch: the projected scenes; rotations and welded objects as they were.
        converged: (B,) bool; no overlap deeper than the tolerance is left.
        residual_depth: (B,) m, deepest overlap left.
        moved: (B, N) m, how far each object was moved.
        heap: (B,) bool; objects were so deep in each other that they were spread to free places.
        valid: (B,) bool.
    """

    batch: SceneBatch
    converged: Tensor
    residual_depth: Tensor
    moved: Tensor
    heap: Tensor
    valid: Tensor


@dataclass(frozen=True)
class ReadyResult:
    """Scenes made ready for a simulator.

    Attributes:
        batch: projected and settled scenes, of the best round each.
        ready: (B, N) bool; free objects that are simulation-ready there (see :func:`make_ready`).
        counts: (B,) int64, ready objects per scene.
        finished: (B,) bool; False where the scene's work budget was spent first: the batch is the best effort, and
            objects that were not judged are not ready. False also where ``valid`` is False.
        valid: (B,) bool, of the first round.
    """

    batch: SceneBatch
    ready: Tensor
    counts: Tensor
    finished: Tensor
    valid: Tensor
