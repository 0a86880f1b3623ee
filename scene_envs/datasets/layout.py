"""Conversion of file rows to scenes of a scene type: units, categories, fixed objects first, keys."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_envs.datasets.files import Rows
from scene_envs.datasets.info import DatasetInfo
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.rotations import project_to_so3
from scene_envs.scene import CATEGORY, POSE, POSE_FEATURES, ROTATION, SceneBatch
from scene_envs.scene_types import FixedObject, SceneType

FIXED_TOLERANCE = 1e-3
"""Largest difference (m, and entries of the rotation matrix) of a fixed object's pose from the scene type's."""
_ONE_HOT = 0.1
"""Largest difference of a one-hot entry from 0 or 1."""
_ROTATION = 0.05
"""Largest difference of R^T R from the identity per entry; above 1e-5, the matrix is projected to SO(3)."""
_KEYS_AT_ONCE = 1024
"""Scenes whose keys are computed together: small enough for the processor's cache."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Conversion of the files of one dataset to scenes of a scene type.

    Attributes:
        info: Metadata of the files.
        scene_type: Scene type of the scenes.
        aliases: Mapping of model paths, or their stems, to asset names.
        fixed_tolerance: Largest distance (m, rotation entries) of a fixed object from the scene type's pose, which it
            then gets. ``math.inf`` accepts any pose.
        slots: N of the scenes; None takes that of the file.
    """

    info: DatasetInfo
    scene_type: SceneType
    aliases: Mapping[str, str] = field(default_factory=dict)
    fixed_tolerance: float = FIXED_TOLERANCE
    slots: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "_categories", self.info.categories_in(self.scene_type, self.aliases))

    @property
    def normalizer(self) -> Normalizer:
        """The files' normalizer with features in the order of the scene type.

        Assets without a path in the files, or with several, are scaled like *empty*.
        """
        found: Tensor = self._categories  # type: ignore[attr-defined]
        order = torch.full((self.scene_type.num_assets + 1,), len(self.info.model_paths))
        order[found] = torch.arange(len(found))
        doubled = torch.bincount(found, minlength=len(order)) > 1
        order[doubled] = len(self.info.model_paths)
        features = torch.cat([torch.arange(POSE_FEATURES), POSE_FEATURES + order])
        files = self.info.normalizer
        return Normalizer(*(v[features] for v in (files.scale, files.min, files.input_min, files.input_max)))

    def scenes(self, rows: Rows) -> Tensor:
        """(M, N, D) float32 raw scenes of ``rows``: fixed objects in the first slots, exact one-hots and rotations.

        Raises:
            CorruptFileError: a value is not finite, a slot is not one-hot or has no rotation (row and slot named).
            InvalidInputError: a fixed object is missing and no slot is empty, or stands elsewhere (row named).
        """
        values = torch.from_numpy(np.array(rows.scenes))  # a copy: arrow's memory is read-only
        if not len(values):
            slots = self.scene_type.slots if self.slots is None else self.slots
            return torch.empty(0, slots, self.scene_type.features)
        _require_none(~torch.isfinite(values).all(dim=-1), rows, "holds a value that is not finite")
        raw = self.info.normalizer.unnormalize(values)
        one_hot = raw[..., CATEGORY]
        found = one_hot.argmax(dim=-1)
        exact = torch.nn.functional.one_hot(found, one_hot.shape[-1])
        _require_none((one_hot - exact).abs().amax(dim=-1) > _ONE_HOT, rows, "is not one-hot over the assets and empty")
        categories = self._categories[found]  # type: ignore[attr-defined]
        empty = self.scene_type.num_assets
        rotations = self._rotations(raw[..., ROTATION].unflatten(-1, (3, 3)), categories != empty, rows)
        batch = SceneBatch.from_parts(raw[..., :3], rotations, categories, self.scene_type)
        if self.slots is not None:
            batch = batch.with_slots(self.slots)
        return place_fixed(batch, self.fixed_tolerance, rows.place, rows.start).tensor

    def _rotations(self, matrices: Tensor, present: Tensor, rows: Rows) -> Tensor:
        gram = matrices.transpose(-1, -2) @ matrices
        error = (gram - torch.eye(3, dtype=gram.dtype)).abs().amax(dim=(-1, -2)) * present
        flipped = present & (torch.linalg.det(matrices) < 0)
        _require_none((error > _ROTATION) | flipped, rows, "has no rotation matrix in its features 3 to 11")
        loose = error > 1e-5
        if not bool(loose.any()):
            return matrices
        fitted = matrices.clone()
        fitted[loose] = project_to_so3(matrices[loose].float()).to(matrices)
        return fitted


def place_fixed(batch: SceneBatch, tolerance: float, place: str = "the batch", start: int = 0) -> SceneBatch:
    """The same scenes with the scene type's fixed objects in the first slots, in order and in their exact poses.

    Other objects keep their order. A fixed object that a scene lacks is added where a slot is empty.

    Args:
        batch: B scenes, fixed objects in any slot.
        tolerance: Largest distance (m, rotation entries) of fixed objects from their poses.
        place: Source of the scenes, for messages.
        start: Row of the first scene in the source, for messages.

    Raises:
        InvalidInputError: a fixed object stands elsewhere, or is missing from a scene without an empty slot.
    """
    tensor = batch.tensor.clone()
    for slot, fixed in enumerate(batch.scene_type.fixed):
        wanted = _fixed_row(fixed, batch.scene_type)
        rest = tensor[:, slot:]
        is_it = rest[..., CATEGORY].argmax(dim=-1) == int(wanted[CATEGORY].argmax())
        distance = (rest[..., POSE] - wanted[POSE]).abs().amax(dim=-1).masked_fill(~is_it, torch.inf)
        nearest = distance.argmin(dim=1)
        there = is_it.any(dim=1)
        off = there & (distance.amin(dim=1) > tolerance)
        if bool(off.any()):
            row = int(torch.nonzero(off)[0])
            pose = [round(value, 4) for value in rest[row, int(nearest[row]), POSE].tolist()]
            raise InvalidInputError(
                f"row {start + row} of {place} has the fixed {fixed.asset!r} at {pose[:3]} m, rotation {pose[3:]}; "
                f"scene type {batch.scene_type.name!r} has it at {list(fixed.translation)} m, rotation "
                f"{list(fixed.rotation)}. Move the scenes, or accept and overwrite it with fixed_tolerance=math.inf"
            )
        is_empty = rest[..., -1] > 0.5
        lost = ~there & ~is_empty.any(dim=1)
        if bool(lost.any()):
            raise InvalidInputError(
                f"row {start + int(torch.nonzero(lost)[0])} of {place} lacks the fixed {fixed.asset!r} of "
                f"{batch.scene_type.name!r} and has no empty slot for it; pass slots={tensor.shape[1] + 1}"
            )
        source = slot + torch.where(there, nearest, is_empty.int().argmax(dim=1))
        tensor = _to_slot(tensor, source, slot)
        tensor[:, slot] = wanted
    return SceneBatch(tensor, batch.scene_type)


def _to_slot(tensor: Tensor, source: Tensor, slot: int) -> Tensor:
    """Slot ``source`` (B,) moved to ``slot``; the slots between move up by one."""
    index = torch.arange(tensor.shape[1]).expand(tensor.shape[:2])
    moved = (index > slot) & (index <= source[:, None])
    index = torch.where(moved, index - 1, index)
    index[:, slot] = source
    return tensor.gather(1, index[..., None].expand_as(tensor))


def _fixed_row(fixed: FixedObject, scene_type: SceneType) -> Tensor:
    row = torch.zeros(scene_type.features)
    row[POSE] = torch.tensor([*fixed.translation, *fixed.rotation])
    row[POSE_FEATURES + scene_type.assets.index(fixed.asset)] = 1.0
    return row


def _require_none(bad: Tensor, rows: Rows, what: str) -> None:
    """Raise CorruptFileError for the first slot marked in ``bad`` (M, N)."""
    if bool(bad.any()):
        row, slot = torch.nonzero(bad)[0].tolist()
        raise CorruptFileError(f"row {rows.start + row} of {rows.place!r}, slot {slot}, {what}")


def scene_keys(tensor: Tensor) -> NDArray[np.uint64]:
    """(M,) keys of raw scenes (M, N, D): equal for the same objects in the same poses, in any order of slots.

    Rows of a dataset that repeat a scene with another prompt share one key. The poses must be bit-equal.
    """
    chunks = [_chunk_keys(chunk) for chunk in tensor.split(_KEYS_AT_ONCE)]
    return np.concatenate(chunks) if chunks else np.empty(0, dtype=np.uint64)


def _chunk_keys(tensor: Tensor) -> NDArray[np.uint64]:
    words = (tensor.float() + 0.0).contiguous().numpy().view(np.uint32).astype(np.uint64)  # + 0.0: no minus zero
    hashed = np.zeros(words.shape[:2], dtype=np.uint64)
    with np.errstate(over="ignore"):
        for feature in range(words.shape[-1]):
            hashed = mix_bits(hashed ^ words[..., feature])
        hashed[(tensor[..., -1] > 0.5).numpy()] = 0
        return mix_bits(hashed.sum(axis=1, dtype=np.uint64))


def mix_bits(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Scatter 64-bit values evenly (the finaliser of SplitMix64, Steele et al. 2014)."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
