"""Choice of a pool of physics workers: processes of this machine, or of a Ray cluster."""

from __future__ import annotations

from scene_envs.errors import InvalidInputError
from scene_envs.physics.pool import PhysicsPool
from scene_envs.physics.ray_pool import RayPhysicsPool


def make_pool(workers: int | str, timeout: float = 60.0) -> PhysicsPool:
    """A pool of processes of this machine, or with ``"ray"`` of a Ray cluster.

    Args:
        workers: number of processes, 0 for this one alone; ``"ray"`` for as many as the cluster has CPUs.
        timeout: as for :class:`PhysicsPool`.

    Raises:
        InvalidInputError: ``workers`` is neither a whole number nor ``"ray"``.

    >>> make_pool(0).workers
    0
    """
    if workers == "ray":
        return RayPhysicsPool(timeout)
    if not isinstance(workers, int):
        raise InvalidInputError(
            f"workers={workers!r}: give a number of processes, 0 for none, or ray for a Ray cluster"
        )
    return PhysicsPool(workers, timeout)
