"""Datasets in memory: raw scenes with prompts and normalizer, their parts, and scenes in the categories of a union."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_envs.datasets.files import (
    METADATA,
    DatasetInfo,
    Rows,
    encode_shard,
    find_files,
    find_metadata,
    make_metadata,
    read_metadata,
    read_rows,
    shard_name,
    write_bytes,
    write_metadata,
)
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.files import find_scenes, is_dataset, scene_files
from scene_envs.normalizer import Normalizer
from scene_envs.rotations import project_to_so3
from scene_envs.scene import CATEGORY, POSE, POSE_FEATURES, ROTATION, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

_LOGGER = logging.getLogger(__name__)
Keys = NDArray[np.uint64]
"""(M,) keys of scenes, as of :func:`scene_keys`."""
FIXED_TOLERANCE = 1e-3
"""Largest difference (m, and entries of the rotation matrix) of a fixed object's pose from the scene type's."""
_ONE_HOT = 0.1
"""Largest difference of a one-hot entry from 0 or 1."""
_ROTATION = 0.05
"""Largest difference of R^T R from the identity per entry; above 1e-5, the matrix is projected to SO(3)."""
_KEYS_AT_ONCE = 1024
"""Scenes whose keys are computed together: small enough for the processor's cache."""


@dataclass(frozen=True, eq=False)
class SceneDataset:
    """M scenes of one type with their prompts.

    Attributes:
        tensor: (M, N, D) float32, raw (metres, rotation entries, one-hot).
        prompt_sets: M tuples, all prompts of each scene, at least one; a text stands for a tuple of it.
        normalizer: Normalizer of the files.
        scene_type: Scene type of the scenes.
        metadata: Content of ``metadata.json``.

    >>> scenes = SceneBatch.empty("dimsum_table", 10)
    >>> shifted = scenes.tensor.clone()
    >>> shifted[:, 0, 0] = torch.arange(10) / 10
    >>> dataset = SceneDataset(shifted, ["A scene with 1 object."] * 10, Normalizer.fit(shifted), scenes.scene_type)
    >>> train, test = dataset.split((0.8, 0.2), seed=0)
    >>> len(train) + len(test), test.prompt_sets[0]
    (10, ('A scene with 1 object.',))
    """

    tensor: Tensor
    prompt_sets: list[tuple[str, ...]]
    normalizer: Normalizer
    scene_type: SceneType
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sets = [(prompts,) if isinstance(prompts, str) else tuple(prompts or ()) for prompts in self.prompt_sets]
        if len(sets) != len(self) or not all(texts and all(isinstance(t, str) for t in texts) for texts in sets):
            raise InvalidInputError(f"{len(self)} scenes need as many prompts or tuples of them, got {str(sets)[:99]}")
        object.__setattr__(self, "prompt_sets", sets)
        object.__setattr__(self, "scene_type", get_scene_type(self.scene_type))

    @cached_property
    def prompts(self) -> list[str]:
        """M prompts, the first of each scene."""
        return [prompts[0] for prompts in self.prompt_sets]

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        scene_type: str | SceneType | None = None,
        aliases: Mapping[str, str] | None = None,
        limit: int | None = None,
        fixed_tolerance: float = FIXED_TOLERANCE,
        slots: int | None = None,
    ) -> SceneDataset:
        """Read a whole dataset from disk: parquet or arrow, of this package or of others.

        Categories are matched by model path, never by index; the scene type's fixed objects move to the first
        slots, and are added to scenes that lack them. A folder that is still being generated gives the shards
        that are finished, with a warning (see :attr:`complete`).

        Args:
            path: Folder of ``.parquet`` or ``.arrow`` files, one such file, or a folder that Hugging Face's
                ``Dataset.save_to_disk`` wrote.
            scene_type: Scene type; None takes the one named in the metadata (datasets of others name none).
            aliases: Mapping of model paths, or their stems, to asset names, for datasets with other asset names.
            limit: Largest number of scenes to read.
            fixed_tolerance: Largest distance (m, rotation entries) of fixed objects from the scene type's pose, which
                they then get. ``math.inf`` accepts any pose.
            slots: N of the scenes, at least that of the files; None takes that of the files.

        Raises:
            InvalidInputError: nothing there, no scene type given or named, or a fixed object stands elsewhere.
            CorruptFileError: a file cannot be read, lacks columns or keys, or holds a row that is no scene (row named).
            UnknownNameError: a model path that is no asset of the scene type.
        """
        files = find_files(path)
        info = read_metadata(find_metadata(path))
        layout = Layout(info, _known_type(info, scene_type), aliases or {}, fixed_tolerance, slots)
        parts: list[Tensor] = []
        sets: list[tuple[str, ...]] = []
        for rows in itertools.chain.from_iterable(read_rows(file, layout.info.features) for file in files):
            parts.append(layout.scenes(rows))
            sets += rows.prompt_sets
            if limit is not None and len(sets) >= limit:
                break
        width = max((part.shape[1] for part in parts), default=layout.scene_type.slots)
        padded = [SceneBatch(part, layout.scene_type).with_slots(width).tensor for part in parts]
        tensor = torch.cat(padded)[:limit] if parts else torch.empty(0, width, layout.scene_type.features)
        dataset = cls(tensor, sets[:limit], layout.normalizer, layout.scene_type, layout.info.metadata)
        if (Path(path) / METADATA).is_file() and not dataset.complete and (limit is None or len(dataset) < limit):
            _LOGGER.warning(
                "%r holds %d of the %d requested scenes: shards are missing, or are still being generated; "
                "run the same scene-envs generate command again to make the rest",
                str(path),
                len(dataset),
                int(dataset.metadata["count"]),
            )
        return dataset

    @property
    def complete(self) -> bool:
        """Whether all requested scenes are here (True for datasets without a ``count`` in their metadata)."""
        return len(self) >= int(self.metadata.get("count") or 0)

    @property
    def keys(self) -> Keys:
        """(M,) keys, equal for rows of the same scene; see :func:`~scene_envs.datasets.dataset.scene_keys`."""
        return scene_keys(self.tensor)

    def __len__(self) -> int:
        return self.tensor.shape[0]

    def __getitem__(self, index: slice | Sequence[int] | Tensor) -> SceneDataset:
        """A sub-dataset."""
        chosen = torch.arange(len(self))[index if isinstance(index, slice) else torch.as_tensor(index)]
        sets = [self.prompt_sets[i] for i in chosen.tolist()]
        return SceneDataset(self.tensor[chosen], sets, self.normalizer, self.scene_type, self.metadata)

    def batch(self, index: slice | Sequence[int] | Tensor = slice(None)) -> SceneBatch:
        """Scenes as a :class:`~scene_envs.scene.SceneBatch`."""
        return SceneBatch(self.tensor[index], self.scene_type)

    def split(self, fractions: Sequence[float], seed: int = 0) -> tuple[SceneDataset, ...]:
        """Disjoint parts of about the given sizes; fractions may sum to less than one.

        The part of a scene depends on a hash of its poses and ``seed`` alone. A scene therefore stays in its part when
        the dataset grows or is read in another order, and rows that repeat it (with another prompt) share its part.

        Raises:
            InvalidInputError: a fraction or ``seed`` is negative, or the fractions sum to more than one.
        """
        if not len(fractions) or any(fraction < 0 for fraction in fractions) or sum(fractions) > 1 + 1e-9:
            raise InvalidInputError(f"fractions must be >= 0 and sum to at most 1, got {list(fractions)}")
        if seed < 0:
            raise InvalidInputError(f"a split needs seed >= 0, got {seed}")
        draws = mix_bits(self.keys ^ mix_bits(np.array([seed], dtype=np.uint64))) / 2.0**64  # (M,) in [0, 1]
        bounds = itertools.pairwise(itertools.accumulate(map(float, fractions), initial=0.0))
        inside = [(draws >= low) & ((draws < high) | (high >= 1 - 1e-9)) for low, high in bounds]
        return tuple(self[torch.from_numpy(np.flatnonzero(rows))] for rows in inside)

    def save(self, output: str | os.PathLike[str], *, shard_size: int = 2000) -> Path:
        """Write as a dataset folder that :meth:`load` reads.

        Raises:
            InvalidInputError: the folder holds a dataset.
            StorageError: a file cannot be written.
        """
        folder = Path(output)
        if any(folder.glob("*.parquet")):
            raise InvalidInputError(f"{str(folder)!r} already holds parquet files; choose an empty folder")
        metadata = make_metadata(self.scene_type, self.normalizer, count=len(self))
        metadata["max_num_objects_per_scene"] = self.tensor.shape[1]
        write_metadata(folder, metadata)
        for index, start in enumerate(range(0, len(self), shard_size)):
            chunk = slice(start, start + shard_size)
            scenes = self.normalizer.normalize(self.tensor[chunk]).numpy()
            write_bytes(folder / shard_name(index), encode_shard(scenes, self.prompt_sets[chunk], {}))
        return folder


def load_scenes(path: Path, count: int | None = None) -> SceneBatch:
    """Scenes from a scene file, a folder of them, a run's folder with a scene file, a dataset or a file of a dataset:
    the first ``count``, or all with None, of files in order of name. Raises InvalidInputError where ``count`` is below
    1, ``path`` does not exist, or its files are of several scene types.
    """
    if count is not None and count < 1:
        raise InvalidInputError(f"count must be at least 1, or null for all, got {count}")
    path = find_scenes(path)
    if is_dataset(path):
        return SceneDataset.load(path, limit=count).batch()
    files = scene_files(path) if path.is_dir() else [path]
    batches = [SceneBatch.load(file) for file in files]
    names = sorted({batch.scene_type.name for batch in batches})
    if len(names) > 1:
        raise InvalidInputError(
            f"the scene files of {str(path)!r} are of several scene types, {', '.join(names)}; name one of the files"
        )
    slots = max(batch.tensor.shape[1] for batch in batches)
    return SceneBatch.concatenate([batch.with_slots(slots) for batch in batches])[:count]


def to_union(batch: SceneBatch, union: SceneType) -> SceneBatch:
    """The same scenes in the categories of ``union``, with empty slots added up to the slots of ``union``, which is a
    result of :func:`~scene_envs.scene_types.union_scene_type` or any scene type with the assets in ``batch``. Raises
    InvalidInputError for an asset that ``union`` lacks.
    """
    known = {name: index for index, name in enumerate(union.assets)}
    table = torch.tensor([known.get(name, -1) for name in batch.scene_type.assets] + [union.num_assets])
    categories = table.to(batch.tensor.device)[batch.categories]
    if bool((categories < 0).any()):
        scene, slot = torch.nonzero(categories < 0)[0].tolist()
        asset = batch.scene_type.assets[int(batch.categories[scene, slot])]
        raise InvalidInputError(f"scene {scene} holds {asset!r}, which scene type {union.name!r} does not have")
    there = SceneBatch.from_parts(batch.translations, batch.rotations, categories, union)
    return there.with_slots(max(union.slots, batch.tensor.shape[1]))


def union_normalizer(normalizers: Sequence[Normalizer], union: SceneType) -> Normalizer:
    """The normalizer of ``union`` whose range covers those of all ``normalizers`` of its types. Poses take the widest
    range of any; a pose feature is constant when it is so in all, at the same value. One-hots take [0, 1].
    """
    if not normalizers:
        raise InvalidInputError("a union's normalizer needs at least one normalizer, got none")
    low, high = torch.zeros(union.features), torch.ones(union.features)
    low[POSE] = torch.stack([n.input_min[POSE] for n in normalizers]).amin(dim=0)
    high[POSE] = torch.stack([n.input_max[POSE] for n in normalizers]).amax(dim=0)
    return Normalizer.from_range(low, high)


def _known_type(info: DatasetInfo, scene_type: str | SceneType | None) -> SceneType:
    """The scene type, or the one that the metadata name; errors as for :meth:`SceneDataset.load`."""
    if scene_type is not None:
        return get_scene_type(scene_type)
    if info.scene_type is None:
        raise InvalidInputError(f"{str(info.path)!r} names no scene type; pass scene_type=")
    try:
        return get_scene_type(info.scene_type)
    except (InvalidInputError, UnknownNameError) as error:
        raise type(error)(f"{str(info.path)!r}: {error} Register it, or pass scene_type=") from error


@dataclass(frozen=True, eq=False)
class Layout:
    """Conversion of the files of one dataset to scenes of a scene type."""

    info: DatasetInfo
    scene_type: SceneType
    aliases: Mapping[str, str] = field(default_factory=dict)  # model paths, or their stems, to asset names
    fixed_tolerance: float = FIXED_TOLERANCE  # m, rotation entries: largest distance from the pose it gets
    slots: int | None = None  # N of the scenes; None takes that of the file

    @cached_property
    def _categories(self) -> Tensor:
        return self.info.categories_in(self.scene_type, self.aliases)

    @property
    def normalizer(self) -> Normalizer:
        """The files' normalizer with features in the order of the scene type; assets without a path in the files, or
        with several, are scaled like *empty*.
        """
        found = self._categories
        order = torch.full((self.scene_type.num_assets + 1,), len(self.info.model_paths))
        order[found] = torch.arange(len(found))
        doubled = torch.bincount(found, minlength=len(order)) > 1
        order[doubled] = len(self.info.model_paths)
        features = torch.cat([torch.arange(POSE_FEATURES), POSE_FEATURES + order])
        files = self.info.normalizer
        return Normalizer(*(v[features] for v in (files.scale, files.min, files.input_min, files.input_max)))

    def scenes(self, rows: Rows) -> Tensor:
        """(M, N, D) float32 raw scenes of ``rows``: fixed objects in the first slots, exact one-hots and rotations.
        Raises CorruptFileError for values not finite, not one-hot or without rotation, and InvalidInputError for a
        fixed object that stands elsewhere, or is missing where no slot is empty.
        """
        values = torch.from_numpy(np.array(rows.scenes))  # a copy: arrow's memory is read-only
        _require_none(~torch.isfinite(values).all(dim=-1), rows, "holds a value that is not finite")
        raw = self.info.normalizer.unnormalize(values)
        one_hot = raw[..., CATEGORY]
        found = one_hot.argmax(dim=-1)
        exact = torch.nn.functional.one_hot(found, one_hot.shape[-1])
        _require_none((one_hot - exact).abs().amax(dim=-1) > _ONE_HOT, rows, "is not one-hot over the assets and empty")
        categories = self._categories[found]
        empty = self.scene_type.num_assets
        rotations = self._rotations(raw[..., ROTATION].unflatten(-1, (3, 3)), categories != empty, rows)
        batch = SceneBatch.from_parts(raw[..., :3], rotations, categories, self.scene_type)
        if self.slots is not None:
            batch = batch.with_slots(self.slots)
        return _place_fixed(batch, self.fixed_tolerance, rows).tensor

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


def _place_fixed(batch: SceneBatch, tolerance: float, rows: Rows) -> SceneBatch:
    """The scenes of ``rows`` with the scene type's fixed objects in the first slots, in order and in their exact poses;
    the others keep their order. A missing fixed object is added where a slot is empty; one that is farther than
    ``tolerance`` (m, rotation entries) from its pose is refused.
    """
    tensor = batch.tensor.clone()
    for slot, fixed in enumerate(batch.scene_type.fixed):
        category = batch.scene_type.assets.index(fixed.asset)
        wanted = torch.zeros(batch.scene_type.features)
        wanted[POSE] = torch.tensor([*fixed.translation, *fixed.rotation])
        wanted[POSE_FEATURES + category] = 1.0
        rest = tensor[:, slot:]
        is_it = rest[..., CATEGORY].argmax(dim=-1) == category
        distance = (rest[..., POSE] - wanted[POSE]).abs().amax(dim=-1).masked_fill(~is_it, torch.inf)
        nearest = distance.argmin(dim=1)
        there = is_it.any(dim=1)
        off = there & (distance.amin(dim=1) > tolerance)
        if bool(off.any()):
            row = int(torch.nonzero(off)[0])
            pose = [round(value, 4) for value in rest[row, int(nearest[row]), POSE].tolist()]
            raise InvalidInputError(
                f"row {rows.start + row} of {rows.place} has the fixed {fixed.asset!r} at {pose[:3]} m, rotation "
                f"{pose[3:]}; scene type {batch.scene_type.name!r} has it at {list(fixed.translation)} m, rotation "
                f"{list(fixed.rotation)}. Move the scenes, or accept and overwrite it with fixed_tolerance=math.inf"
            )
        is_empty = rest[..., -1] > 0.5
        lost = ~there & ~is_empty.any(dim=1)
        if bool(lost.any()):
            raise InvalidInputError(
                f"row {rows.start + int(torch.nonzero(lost)[0])} of {rows.place} lacks the fixed {fixed.asset!r} of "
                f"{batch.scene_type.name!r} and has no empty slot for it; pass slots={tensor.shape[1] + 1}"
            )
        source = slot + torch.where(there, nearest, is_empty.int().argmax(dim=1))
        index = torch.arange(tensor.shape[1]).expand(tensor.shape[:2])
        moves_up = (index > slot) & (index <= source[:, None])
        index = torch.where(moves_up, index - 1, index)  # the object of slot ``source`` is replaced by ``wanted``
        tensor = tensor.gather(1, index[..., None].expand_as(tensor))
        tensor[:, slot] = wanted
    return SceneBatch(tensor, batch.scene_type)


def _require_none(bad: Tensor, rows: Rows, what: str) -> None:
    """Raise CorruptFileError for the first slot marked in ``bad`` (M, N)."""
    if bool(bad.any()):
        row, slot = torch.nonzero(bad)[0].tolist()
        raise CorruptFileError(f"row {rows.start + row} of {rows.place!r}, slot {slot}, {what}")


def scene_keys(tensor: Tensor) -> Keys:
    """(M,) keys of raw scenes (M, N, D): equal for the same objects in bit-equal poses, in any order of slots. Rows of
    a dataset that repeat a scene with another prompt share one key.
    """
    chunks = [_chunk_keys(chunk) for chunk in tensor.split(_KEYS_AT_ONCE)]
    return np.concatenate(chunks) if chunks else np.empty(0, dtype=np.uint64)


def _chunk_keys(tensor: Tensor) -> Keys:
    words = (tensor.float() + 0.0).contiguous().numpy().view(np.uint32).astype(np.uint64)  # + 0.0: no minus zero
    hashed = np.zeros(words.shape[:2], dtype=np.uint64)
    with np.errstate(over="ignore"):
        for feature in range(words.shape[-1]):
            hashed = mix_bits(hashed ^ words[..., feature])
        hashed[(tensor[..., -1] > 0.5).numpy()] = 0
        return mix_bits(hashed.sum(axis=1, dtype=np.uint64))


def mix_bits(values: Keys) -> Keys:
    """Scatter 64-bit values evenly (the finaliser of SplitMix64, Steele et al. 2014)."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
