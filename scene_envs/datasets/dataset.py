"""A dataset in memory: raw scenes, prompts, normalizer."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_envs.datasets import store
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type


@dataclass(frozen=True, eq=False)
class SceneDataset:
    """M scenes of one type with a prompt each.

    Attributes:
        tensor: (M, N, D) float32, raw (metres, rotation entries, one-hot).
        prompts: M prompts.
        normalizer: the normalizer the files were written with.
        scene_type: the scene type.
        metadata: the content of ``metadata.json``.

    >>> scenes = SceneBatch.empty("dimsum_table", 10)
    >>> dataset = SceneDataset(scenes.tensor, ["A scene with 1 object."] * 10, Normalizer.fit(scenes.tensor),
    ...                        scenes.scene_type)
    >>> train, test = dataset.split((0.8, 0.2), seed=0)
    >>> len(train), len(test)
    (8, 2)
    """

    tensor: Tensor
    prompts: list[str]
    normalizer: Normalizer
    scene_type: SceneType
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.prompts) != self.tensor.shape[0]:
            raise InvalidInputError(f"{self.tensor.shape[0]} scenes need as many prompts, got {len(self.prompts)}")

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        scene_type: str | SceneType | None = None,
        aliases: Mapping[str, str] | None = None,
        limit: int | None = None,
    ) -> SceneDataset:
        """Read a dataset folder, or one parquet file with its ``metadata.json`` beside it.

        Categories are matched by model path, never by index. A folder that is still being generated
        gives the shards that are finished (see :attr:`complete`).

        Args:
            path: folder or ``.parquet`` file.
            scene_type: overrides the scene type named in the metadata (datasets of others name none).
            aliases: model path, or its stem, to asset name, for datasets with other asset names.
            limit: read at most this many scenes.

        Raises:
            InvalidInputError: nothing there, or no scene type given or named.
            CorruptFileError: a file cannot be read, or lacks columns or keys.
            UnknownNameError: a model path that is no asset of the scene type.
        """
        path = Path(path)
        folder = path if path.is_dir() else path.parent
        files = sorted(path.glob("[!.]*.parquet")) if path.is_dir() else [path]
        if not path.exists() or not files:
            raise InvalidInputError(f"no parquet files at {str(path)!r}; give a dataset folder or a .parquet file")
        metadata = store.read_metadata(folder / store.METADATA)
        name = scene_type if scene_type is not None else metadata.get("scene_type")
        if name is None:
            raise InvalidInputError(f"{str(folder / store.METADATA)!r} names no scene type; pass scene_type=")
        resolved = get_scene_type(name)
        normalizer = Normalizer.from_state(metadata["normalizer_state"])
        order = _feature_order(metadata["model_paths"], resolved, aliases or {})
        if normalizer.scale.shape[0] != resolved.features:
            raise CorruptFileError(
                f"the normalizer in {str(folder / store.METADATA)!r} has {normalizer.scale.shape[0]} features, "
                f"{resolved.name!r} has {resolved.features}"
            )
        parts: list[Tensor] = []
        prompts: list[str] = []
        for file in files:
            normalised, texts = store.read_shard(file, resolved.features)
            parts.append(normalizer.unnormalize(torch.from_numpy(normalised.copy()))[..., order])
            prompts += texts
            if limit is not None and len(prompts) >= limit:
                break
        tensor = torch.cat(parts)[:limit]
        reordered = Normalizer(*(v[order] for v in _vectors(normalizer)))
        return cls(tensor, prompts[:limit], reordered, resolved, metadata)

    @property
    def complete(self) -> bool:
        """Whether all scenes that were asked for are here (True for datasets that do not say)."""
        return len(self) >= int(self.metadata.get("count", 0))

    def __len__(self) -> int:
        return self.tensor.shape[0]

    def __getitem__(self, index: slice | Sequence[int] | Tensor) -> SceneDataset:
        """A sub-dataset."""
        chosen = torch.arange(len(self))[index if isinstance(index, slice) else torch.as_tensor(index)]
        prompts = [self.prompts[i] for i in chosen.tolist()]
        return SceneDataset(self.tensor[chosen], prompts, self.normalizer, self.scene_type, self.metadata)

    def batch(self, index: slice | Sequence[int] | Tensor = slice(None)) -> SceneBatch:
        """Scenes as a :class:`~scene_envs.scene.SceneBatch`."""
        return SceneBatch(self.tensor[index], self.scene_type)

    def split(self, fractions: Sequence[float], seed: int = 0) -> tuple[SceneDataset, ...]:
        """Disjoint random parts of the given sizes; fractions may sum to less than one.

        Raises:
            InvalidInputError: a fraction is negative, or they sum to more than one.
        """
        if any(fraction < 0 for fraction in fractions) or sum(fractions) > 1 + 1e-9:
            raise InvalidInputError(f"fractions must be >= 0 and sum to at most 1, got {list(fractions)}")
        order = torch.randperm(len(self), generator=torch.Generator().manual_seed(seed))
        edges = [round(bound * len(self)) for bound in accumulate(fractions, initial=0.0)]
        return tuple(self[order[low:high]] for low, high in pairwise(edges))

    def save(self, output: str | os.PathLike[str], *, shard_size: int = 2000) -> Path:
        """Write as a dataset folder that :meth:`load` reads."""
        folder = Path(output)
        if any(folder.glob("*.parquet")):
            raise InvalidInputError(f"{str(folder)!r} already holds parquet files; choose an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
        metadata = store.make_metadata(self.scene_type, self.normalizer, count=len(self))
        store.write_json(folder / store.METADATA, metadata)
        for index, start in enumerate(range(0, len(self), shard_size)):
            chunk = slice(start, start + shard_size)
            scenes = self.normalizer.normalize(self.tensor[chunk]).numpy()
            store.write_shard(folder / store.shard_name(index), scenes, self.prompts[chunk], {})
        return folder


def _vectors(normalizer: Normalizer) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return normalizer.scale, normalizer.min, normalizer.input_min, normalizer.input_max


def _feature_order(model_paths: Sequence[str], scene_type: SceneType, aliases: Mapping[str, str]) -> Tensor:
    """(D,) int64: for each feature of ``scene_type``, the feature of the file that holds it."""
    names = []
    for path in model_paths:
        stem = Path(path).stem
        name = aliases.get(path, aliases.get(stem, stem))
        if name not in scene_type.assets:
            raise unknown_name(
                f"asset of {scene_type.name!r} (model path {path!r}; pass aliases=)", name, scene_type.assets
            )
        names.append(name)
    missing = [asset for asset in scene_type.assets if asset not in names]
    if missing:
        raise CorruptFileError(f"model_paths lacks the assets {missing} of scene type {scene_type.name!r}")
    categories = [12 + names.index(asset) for asset in scene_type.assets]
    return torch.tensor([*range(12), *categories, 12 + len(names)])
