"""A dataset in memory: raw scenes, prompts, normalizer."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_envs.datasets.store import METADATA, make_metadata, shard_name, write_shard
from scene_envs.datasets.files import Rows, find_files, find_metadata, list_blocks, read_block, to_rows
from scene_envs.datasets.info import DatasetInfo, read_metadata
from scene_envs.datasets.layout import FIXED_TOLERANCE, Layout, scene_keys
from scene_envs.datasets.splits import Part, check_fractions, split_rows
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.files import with_digest, write_json
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class SceneDataset:
    """M scenes of one type with their prompts.

    Attributes:
        tensor: (M, N, D) float32, raw (metres, rotation entries, one-hot).
        prompts: M prompts, the first of each scene.
        normalizer: Normalizer of the files.
        scene_type: Scene type of the scenes.
        metadata: Content of ``metadata.json``.
        prompt_sets: M tuples, all prompts of each scene, the one in ``prompts`` first.

    >>> scenes = SceneBatch.empty("dimsum_table", 10)
    >>> shifted = scenes.tensor.clone()
    >>> shifted[:, 0, 0] = torch.arange(10) / 10
    >>> dataset = SceneDataset(shifted, ["A scene with 1 object."] * 10, Normalizer.fit(shifted), scenes.scene_type)
    >>> train, test = dataset.split((0.8, 0.2), seed=0)
    >>> len(train), len(test), test.prompt_sets[0]
    (8, 2, ('A scene with 1 object.',))
    """

    tensor: Tensor
    prompts: list[str]
    normalizer: Normalizer
    scene_type: SceneType
    metadata: dict[str, Any] = field(default_factory=dict)
    prompt_sets: list[tuple[str, ...]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if len(self.prompts) != self.tensor.shape[0]:
            raise InvalidInputError(f"{self.tensor.shape[0]} scenes need as many prompts, got {len(self.prompts)}")
        if not self.prompt_sets:
            object.__setattr__(self, "prompt_sets", [(prompt,) for prompt in self.prompts])
        firsts = [prompts[:1] for prompts in self.prompt_sets]
        if firsts != [(prompt,) for prompt in self.prompts]:
            raise InvalidInputError("prompt_sets needs one tuple per scene that starts with the scene's prompt")

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        scene_type: str | SceneType | None = None,
        aliases: Mapping[str, str] | None = None,
        limit: int | None = None,
        metadata: str | os.PathLike[str] | None = None,
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
            metadata: Path of ``metadata.json``, when it is neither in the folder of the files nor in the folder above.
            fixed_tolerance: Largest distance (m, rotation entries) of fixed objects from the scene type's pose, which
                they then get. ``math.inf`` accepts any pose.
            slots: N of the scenes, at least that of the files; None takes that of the files.

        Raises:
            InvalidInputError: nothing there, no scene type given or named, or a fixed object stands elsewhere.
            CorruptFileError: a file cannot be read, lacks columns or keys, or holds a row that is no scene (row named).
            UnknownNameError: a model path that is no asset of the scene type.
        """
        files = find_files(path)
        layout = make_layout(metadata or find_metadata(path), scene_type, aliases, fixed_tolerance, slots)
        blocks = (block for file in files for block in list_blocks(file))
        dataset = cls._collect((read_block(block, layout.info.features) for block in blocks), layout, limit)
        own = metadata is None and (Path(path) / METADATA).is_file()
        if own and not dataset.complete and (limit is None or len(dataset) < limit):
            logger.warning(
                "%r holds %d of the %d requested scenes: shards are missing, or are still being generated; "
                "run the same scene-envs generate command again to make the rest",
                str(path),
                len(dataset),
                int(dataset.metadata["count"]),
            )
        return dataset

    @classmethod
    def from_huggingface(
        cls,
        dataset: Any,
        metadata: str | os.PathLike[str],
        *,
        scene_type: str | SceneType | None = None,
        aliases: Mapping[str, str] | None = None,
        limit: int | None = None,
        fixed_tolerance: float = FIXED_TOLERANCE,
        slots: int | None = None,
    ) -> SceneDataset:
        """From a ``datasets.Dataset`` (one split, as ``load_dataset`` gives it) and its ``metadata.json``.

        Arguments and errors as for :meth:`load`.
        """
        layout = make_layout(metadata, scene_type, aliases, fixed_tolerance, slots)

        def rows() -> Iterator[Rows]:
            start = 0
            for table in dataset.with_format("arrow").iter(batch_size=2000):
                yield to_rows(table, layout.info.features, "the dataset", start)
                start += table.num_rows

        return cls._collect(rows(), layout, limit)

    @classmethod
    def _collect(cls, blocks: Iterable[Rows], layout: Layout, limit: int | None) -> SceneDataset:
        parts: list[Tensor] = []
        sets: list[tuple[str, ...]] = []
        for rows in blocks:
            parts.append(layout.scenes(rows))
            sets += rows.prompt_sets
            if limit is not None and len(sets) >= limit:
                break
        width = max((part.shape[1] for part in parts), default=layout.scene_type.slots)
        padded = [SceneBatch(part, layout.scene_type).with_slots(width).tensor for part in parts]
        tensor = torch.cat(padded)[:limit] if parts else torch.empty(0, width, layout.scene_type.features)
        return cls.from_sets(tensor, sets[:limit], layout.normalizer, layout.scene_type, layout.info.metadata)

    @classmethod
    def from_sets(
        cls,
        tensor: Tensor,
        prompt_sets: Sequence[tuple[str, ...]],
        normalizer: Normalizer,
        scene_type: str | SceneType,
        metadata: dict[str, Any] | None = None,
    ) -> SceneDataset:
        """From raw scenes (M, N, D) with a tuple of prompts each; the first of each tuple is the prompt."""
        sets = list(prompt_sets)
        first = [prompts[0] for prompts in sets]
        return cls(tensor, first, normalizer, get_scene_type(scene_type), metadata or {}, sets)

    @property
    def complete(self) -> bool:
        """Whether all requested scenes are here (True for datasets without a ``count`` in their metadata)."""
        return len(self) >= int(self.metadata.get("count") or 0)

    @property
    def keys(self) -> NDArray[np.uint64]:
        """(M,) keys, equal for rows of the same scene; see :func:`~scene_envs.datasets.layout.scene_keys`."""
        return scene_keys(self.tensor)

    def __len__(self) -> int:
        return self.tensor.shape[0]

    def __getitem__(self, index: slice | Sequence[int] | Tensor) -> SceneDataset:
        """A sub-dataset."""
        chosen = torch.arange(len(self))[index if isinstance(index, slice) else torch.as_tensor(index)]
        sets = [self.prompt_sets[i] for i in chosen.tolist()]
        return self.from_sets(self.tensor[chosen], sets, self.normalizer, self.scene_type, self.metadata)

    def batch(self, index: slice | Sequence[int] | Tensor = slice(None)) -> SceneBatch:
        """Scenes as a :class:`~scene_envs.scene.SceneBatch`."""
        return SceneBatch(self.tensor[index], self.scene_type)

    def split(self, fractions: Sequence[float], seed: int = 0) -> tuple[SceneDataset, ...]:
        """Disjoint random parts of the given sizes; fractions may sum to less than one.

        Rows that repeat a scene (with another prompt) belong to the same part. When a dataset grows, scenes change
        parts; :meth:`stable_split` keeps each scene in its part.

        Raises:
            InvalidInputError: a fraction is negative, or they sum to more than one.
        """
        return tuple(self[torch.from_numpy(rows)] for rows in split_rows(self.keys, fractions, seed))

    def stable_split(self, fractions: Sequence[float], seed: int = 0) -> tuple[SceneDataset, ...]:
        """Disjoint parts decided scene by scene, so that a scene keeps its part when the dataset grows.

        The given sizes are met on average.

        Raises:
            InvalidInputError: a fraction is negative, or they sum to more than one.
        """
        keys, parts = self.keys, check_fractions(fractions)
        inside = [Part(parts, index, seed).contains(keys) for index in range(len(parts))]
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
        folder.mkdir(parents=True, exist_ok=True)
        metadata = make_metadata(self.scene_type, self.normalizer, count=len(self))
        metadata["max_num_objects_per_scene"] = self.tensor.shape[1]
        write_json(folder / METADATA, with_digest(metadata), indent=2)
        for index, start in enumerate(range(0, len(self), shard_size)):
            chunk = slice(start, start + shard_size)
            scenes = self.normalizer.normalize(self.tensor[chunk]).numpy()
            write_shard(folder / shard_name(index), scenes, self.prompt_sets[chunk], {})
        return folder


def make_layout(
    metadata: str | os.PathLike[str],
    scene_type: str | SceneType | None,
    aliases: Mapping[str, str] | None,
    fixed_tolerance: float,
    slots: int | None,
) -> Layout:
    """Layout of files with this ``metadata.json``; arguments and errors as for :meth:`SceneDataset.load`."""
    info: DatasetInfo = read_metadata(metadata)
    name = scene_type if scene_type is not None else info.scene_type
    if name is None:
        raise InvalidInputError(f"{str(info.path)!r} names no scene type; pass scene_type=")
    try:
        known = get_scene_type(name)
    except (InvalidInputError, UnknownNameError) as error:
        if scene_type is not None:
            raise
        raise type(error)(f"{str(info.path)!r}: {error} Register it, or pass scene_type=") from error
    return Layout(info, known, aliases or {}, fixed_tolerance, slots)
