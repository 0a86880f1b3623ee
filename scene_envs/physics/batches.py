"""Batches of scenes as chunks for the kernels, and the kernels' results as tensors."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.physics.kernels import Chunk
from scene_envs.physics.pool import PhysicsPool
from scene_envs.rotations import geodesic_angle, project_to_so3
from scene_envs.scene import SceneBatch, require_rigid_poses

_LOGGER = logging.getLogger(__name__)
_CHUNK = 8
"""Scenes per message to a worker."""

Rows = list[dict[str, Any] | None]
"""Results of a kernel, one per scene."""


def run_kernel(
    kernel: str,
    batch: SceneBatch,
    options: dict[str, Any],
    pool: PhysicsPool | None,
    units: Tensor | None = None,
) -> Rows:
    """Run a kernel on a batch: the results of each scene, None where it failed twice.

    Args:
        kernel: Name of a function of :data:`scene_envs.physics.kernels.KERNELS`.
        batch: B scenes.
        options: Keyword arguments of the kernel.
        pool: Worker processes; None computes in this process.
        units: (B,) float64, units that the simulation of each scene may spend; None derives them from its objects.

    Raises:
        InvalidInputError: a pose is not finite, or a matrix is not a rotation; the message names its scene and slot.
    """
    require_rigid_poses(batch)
    translations = batch.translations.double().cpu().numpy()
    rotations = batch.rotations.double().cpu().numpy()
    categories = batch.categories.cpu().numpy()
    workers = max(1, pool.workers) if pool else 1
    size = max(1, min(_CHUNK, -(-len(batch) // workers)))
    limits = None if units is None else units.double().cpu().numpy()
    chunks = []
    for start in range(0, len(batch), size):
        rows = slice(start, start + size)
        some = None if limits is None else limits[rows]
        chunks.append(Chunk(batch.scene_type, translations[rows], rotations[rows], categories[rows], some))
    results = (pool or PhysicsPool(workers=0)).run(kernel, chunks, options)
    if lost := sum(row is not None and not row["valid"] for row in results):
        _LOGGER.debug(
            "%s: %d of %d scenes are invalid: too deep in each other to be simulated or measured, or the simulation "
            "diverged or took more work than a scene may, and was ended", kernel, lost, len(results),
        )  # fmt: skip
    return results


def valid_rows(rows: Rows) -> Tensor:
    """(B,) bool, scenes that were judged."""
    return torch.tensor([row is not None and bool(row["valid"]) for row in rows], dtype=torch.bool)


def spent(rows: Rows) -> Tensor:
    """(B,) float64, units of simulation that each scene took; infinite if the scene failed twice."""
    return torch.tensor([np.inf if row is None else float(row["spent"]) for row in rows], dtype=torch.float64)


def stack(
    rows: Rows,
    batch: SceneBatch,
    name: str,
    dtype: torch.dtype = torch.float32,
    shape: tuple[int, ...] | None = None,
) -> Tensor:
    """(B, N) tensor of a named result (or (B, *shape)), zeros where a row is invalid."""
    shape = (batch.tensor.shape[1],) if shape is None else shape
    out = torch.zeros(len(rows), *shape, dtype=dtype)
    for index, row in enumerate(rows):
        if row is not None and row["valid"]:
            out[index] = torch.as_tensor(np.asarray(row[name]), dtype=dtype)
    return out


def poses_after(rows: Rows, batch: SceneBatch) -> tuple[SceneBatch, Tensor, Tensor]:
    """The batch at its new poses, with displacement (B, N) m and rotation (B, N) rad of each object; all on the CPU."""
    batch = batch.to("cpu")
    translations, rotations = batch.translations.clone(), batch.rotations.clone()
    for index, row in enumerate(rows):
        if row is not None and row["valid"]:
            translations[index] = torch.from_numpy(row["translations"]).float()
            if "rotations" in row:
                rotations[index] = torch.from_numpy(row["rotations"]).float()
    present = ~batch.is_empty
    displacement = (translations - batch.translations).norm(dim=-1) * present
    identity = torch.eye(3).expand_as(rotations)
    before = torch.where(present[..., None, None], batch.rotations, identity)
    after = torch.where(present[..., None, None], project_to_so3(rotations), identity)
    return batch.with_poses(translations, after), displacement, geodesic_angle(before, after) * present
