"""Reader of ``metadata.json``, which needs no other file of the dataset."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_envs.datasets.store import METADATA
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.files import without_digest
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE_FEATURES
from scene_envs.scene_types import SceneType


@dataclass(frozen=True, eq=False)
class DatasetInfo:
    """The content of one ``metadata.json``.

    Attributes:
        path: Path of the file.
        model_paths: C paths; the position of a path is its category *in the files*, C is empty.
        normalizer: Normalizer of the files, with D = 3 + 9 + C + 1 features in the files' order.
        welded_model_paths: Paths of the welded assets.
        slots: N, the number of slots per scene; None when the file does not say.
        scene_type: Name of the scene type; None in datasets of others.
        count: Number of requested scenes; None when the file does not say.
        metadata: All keys of the file but the digest.
    """

    path: Path
    model_paths: tuple[str, ...]
    normalizer: Normalizer
    welded_model_paths: tuple[str, ...] = ()
    slots: int | None = None
    scene_type: str | None = None
    count: int | None = None
    metadata: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def features(self) -> int:
        """D, the length of a slot in the files."""
        return POSE_FEATURES + len(self.model_paths) + 1

    @property
    def stems(self) -> tuple[str, ...]:
        """The names in the model paths, without folder and suffix: ``"package://a/teacup.sdf"`` is ``"teacup"``."""
        return tuple(Path(path).stem for path in self.model_paths)

    def categories_in(self, scene_type: SceneType, aliases: Mapping[str, str] | None = None) -> Tensor:
        """(C + 1,) int64: the category of ``scene_type`` for each category of the files; empty maps to empty.

        Args:
            scene_type: Scene type of the result; it may have assets that the files lack.
            aliases: Mapping of model paths, or their stems, to asset names.

        Raises:
            UnknownNameError: a model path that is no asset of the scene type.
        """
        aliases = aliases or {}
        found = []
        for path, stem in zip(self.model_paths, self.stems, strict=True):
            whole = Path(path).name  # paths of this package have no suffix, but a name may hold a dot
            name = aliases.get(path, aliases.get(stem, whole if whole in scene_type.assets else stem))
            if name not in scene_type.assets:
                kind = f"asset of {scene_type.name!r} (model path {path!r} in {str(self.path)!r}; pass aliases=)"
                raise unknown_name(kind, name, scene_type.assets)
            found.append(scene_type.assets.index(name))
        return torch.tensor([*found, scene_type.num_assets])


def read_metadata(path: str | os.PathLike[str]) -> DatasetInfo:
    """Read a ``metadata.json``, given as the file or as the dataset's folder.

    Raises:
        InvalidInputError: there is no such file.
        CorruptFileError: it is not JSON, does not match its digest, lacks keys (they are named), or its lengths
            contradict each other.
    """
    file = Path(path) / METADATA if Path(path).is_dir() else Path(path)
    if not file.is_file():
        raise InvalidInputError(f"no {METADATA} at {str(file)!r}; a dataset folder holds one")
    try:
        metadata = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{str(file)!r} is not valid JSON: {error}") from error
    if isinstance(metadata, dict):
        metadata = without_digest(metadata, file)
    needed = ("model_paths", "normalizer_state")
    missing = [key for key in needed if not isinstance(metadata, dict) or key not in metadata]
    if missing:
        raise CorruptFileError(f"{str(file)!r} lacks the keys {missing}; a dataset's metadata needs {list(needed)}")
    return _parse(file, metadata)


def _parse(file: Path, metadata: dict[str, Any]) -> DatasetInfo:
    for key in ("model_paths", "welded_object_model_paths"):
        if not isinstance(metadata.get(key) or [], list):
            raise CorruptFileError(f"{str(file)!r}: {key} must be a list of paths, it is {str(metadata[key])[:100]}")
    paths = tuple(map(str, metadata["model_paths"] or ()))
    try:
        normalizer = Normalizer.from_state(metadata["normalizer_state"])
        slots, count = (_whole(metadata, key) for key in ("max_num_objects_per_scene", "count"))
    except (InvalidInputError, TypeError, ValueError) as error:
        raise CorruptFileError(f"{str(file)!r}: {error}") from error
    for key, wanted in (("translation_vec_len", 3), ("model_path_vec_len", len(paths) + 1)):
        found = metadata.get(key, wanted)
        if found != wanted:
            raise CorruptFileError(f"{str(file)!r}: {key} is {found}, expected {wanted} ({len(paths)} model paths)")
    return DatasetInfo(
        path=file,
        model_paths=paths,
        normalizer=_whole_slot(normalizer, len(paths) + 1, file),
        welded_model_paths=tuple(map(str, metadata.get("welded_object_model_paths") or ())),
        slots=slots,
        scene_type=metadata.get("scene_type"),
        count=count,
        metadata=metadata,
    )


def _whole(metadata: dict[str, Any], key: str) -> int | None:
    value = metadata.get(key)
    return None if value is None else int(value)


def _whole_slot(normalizer: Normalizer, one_hot: int, file: Path) -> Normalizer:
    """The normalizer of a whole slot; a pose-only one is extended by the identity on the one-hot features."""
    vectors = (normalizer.scale, normalizer.min, normalizer.input_min, normalizer.input_max)
    lengths = {len(vector) for vector in vectors}
    if lengths == {POSE_FEATURES}:
        kept = (torch.ones, torch.zeros, torch.zeros, torch.ones)
        return Normalizer(*(torch.cat([v, make(one_hot)]) for v, make in zip(vectors, kept, strict=True)))
    if lengths != {POSE_FEATURES + one_hot}:
        raise CorruptFileError(
            f"{str(file)!r}: the normalizer has {sorted(lengths)} features; {one_hot - 1} model paths need "
            f"{POSE_FEATURES + one_hot} (3 translation, 9 rotation matrix, {one_hot} one-hot), or the first "
            f"{POSE_FEATURES}"
        )
    return normalizer
