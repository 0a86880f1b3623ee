"""Results of the physics functions."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from scene_envs.scene import SceneBatch


@dataclass(frozen=True)
class FeasibilityResult:
    """The verdict per object.

    Attributes:
        feasible: (B, N) bool; True for free objects that pass, False for welded and empty slots.
        depth: (B, N) m, deepest overlap of each object with any other, welded ones included.
        displacement: (B, N) m, motion of the object frame; 0 where the object was not simulated.
        rotation: (B, N) rad, angle that the object turned.
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
        slots: Slots of the two objects.
        depth: Deepest overlap of any two of their convex parts, m.
        total: Sum of the overlaps of all pairs of their convex parts, m.
        part_pairs: Number of overlapping pairs of convex parts.
    """

    slots: tuple[int, int]
    depth: float
    total: float
    part_pairs: int


@dataclass(frozen=True)
class PenetrationResult:
    """Overlap between objects; pairs of welded objects do not count.

    Attributes:
        pairs: Overlapping object pairs of each scene, in slot order.
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
        batch: Scenes at their new poses; invalid rows are unchanged.
        displacement: (B, N) m, distance from the given poses.
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
        batch: Projected scenes; rotations and welded objects are unchanged.
        converged: (B,) bool; True where no overlap deeper than the tolerance is left.
        residual_depth: (B,) m, deepest overlap left.
        moved: (B, N) m, distance that each object was moved.
        heap: (B,) bool; True where objects overlapped so deeply that they were spread to free places.
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
        batch: Projected and settled scenes, each of its best round.
        ready: (B, N) bool; free objects that are simulation-ready there (see :func:`make_ready`).
        counts: (B,) int64, ready objects per scene.
        finished: (B,) bool; False where the scene's work budget was spent first: the batch is the best effort, and
            objects that were not judged are not ready. False also where ``valid`` is False.
        valid: (B,) bool; False where the first round could not judge the scene.
    """

    batch: SceneBatch
    ready: Tensor
    counts: Tensor
    finished: Tensor
    valid: Tensor
