"""Dataset file writer: parquet shards of normalised scenes and prompts, and one ``metadata.json``.

The layout is that of the published datasets: column ``scenes`` holds normalised (N, D) float32 scenes,
``language_annotation`` one prompt each; ``metadata.json`` names the assets and holds the normalizer. The further
column ``language_annotations`` holds all prompts of a scene.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.files import replacing, with_digest, without_digest
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType

METADATA = "metadata.json"
SCENES = "scenes"
PROMPTS = "language_annotation"
PROMPT_SETS = "language_annotations"
_NOTES = b"scene_envs"
_MODEL_PATH = "scene_envs/assets/{name}"
_ROW_GROUP = 500
"""Scenes per row group, the unit that a streaming reader holds in memory."""


def shard_name(index: int) -> str:
    """File name of shard ``index``."""
    return f"scenes-{index:05d}.parquet"


def make_metadata(scene_type: SceneType, normalizer: Normalizer, **extra: Any) -> dict[str, Any]:
    """The content of ``metadata.json`` for a dataset of ``scene_type``, with the ``extra`` keys."""
    return {
        "scene_type": scene_type.name,
        "model_paths": [_MODEL_PATH.format(name=name) for name in scene_type.assets],
        "welded_object_model_paths": [_MODEL_PATH.format(name=name) for name in scene_type.welded],
        "translation_vec_len": 3,
        "rotation_parametrization": "rotation_matrix",
        "model_path_vec_len": scene_type.num_assets + 1,
        "max_num_objects_per_scene": scene_type.slots,
        "normalizer_state": normalizer.state(),
        **extra,
    }


def write_bytes(path: Path, content: bytes) -> None:
    """Write one file, whole or not at all; raises :class:`StorageError`."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_shard(
    path: Path, scenes: NDArray[np.float32], prompt_sets: Sequence[tuple[str, ...]], notes: Mapping[str, Any]
) -> None:
    """Write one parquet file atomically.

    Args:
        path: Path of the file.
        scenes: (M, N, D) float32, normalised.
        prompt_sets: Prompts of each of the M scenes; ``language_annotations`` is left out when all have one.
        notes: JSON-able facts for the file's footer, such as reasons for rejected scenes.

    Raises:
        StorageError: the file cannot be written; nothing is left of it.
    """
    write_bytes(path, encode_shard(scenes, prompt_sets, notes))


def encode_shard(
    scenes: NDArray[np.float32], prompt_sets: Sequence[tuple[str, ...]], notes: Mapping[str, Any]
) -> bytes:
    """The bytes of the parquet file that :func:`write_shard` writes; equal for equal arguments."""
    count, slots, features = scenes.shape
    values = pa.array(np.ascontiguousarray(scenes).reshape(-1))
    rows = pa.ListArray.from_arrays(pa.array(np.arange(count * slots + 1, dtype=np.int32) * features), values)
    columns: dict[str, pa.Array] = {
        SCENES: pa.ListArray.from_arrays(pa.array(np.arange(count + 1, dtype=np.int32) * slots), rows),
        PROMPTS: pa.array([prompts[0] for prompts in prompt_sets], pa.string()),
    }
    if any(len(prompts) > 1 for prompts in prompt_sets):
        columns[PROMPT_SETS] = pa.array([list(prompts) for prompts in prompt_sets], pa.list_(pa.string()))
    kept = json.dumps(with_digest({**notes, "rows": count}), sort_keys=True)
    table = pa.table(columns).replace_schema_metadata({_NOTES: kept.encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=_ROW_GROUP, write_page_checksum=True)
    return bytes(sink.getvalue().to_pybytes())


def read_notes(path: Path) -> dict[str, Any]:
    """The facts that :func:`write_shard` kept in the footer, and ``rows``; raises CorruptFileError."""
    file = open_parquet(path)
    footer = file.schema_arrow.metadata or {}
    try:
        notes = without_digest(json.loads(footer.get(_NOTES, b"{}")), path)
        rows = file.metadata.num_rows
        if notes.get("rows", rows) != rows:
            raise ValueError(f"{notes['rows']} rows were written, the file has {rows}")
        return {**notes, "rows": rows}
    except (ValueError, TypeError, AttributeError, CorruptFileError) as error:
        raise CorruptFileError(
            f"{str(path)!r} has a damaged footer; delete it and generate again to remake it"
        ) from error


def verify(path: Path) -> None:
    """Read all of a shard, whose pages carry checksums; raises CorruptFileError."""
    file = open_parquet(path)
    try:
        for _ in file.iter_batches(_ROW_GROUP):
            pass
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptFileError(
            f"{str(path)!r} is damaged ({str(error)[:200]}); delete it and generate again to remake it"
        ) from error


def open_parquet(path: Path) -> pq.ParquetFile:
    """The parquet file at ``path``; raises InvalidInputError (none there) or CorruptFileError."""
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
        _ = file.schema_arrow.names, file.metadata.num_rows  # reading these raises when they are damaged
        return file
    except FileNotFoundError:
        raise InvalidInputError(f"no parquet file at {str(path)!r}") from None
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptFileError(
            f"{str(path)!r} is not a readable parquet file ({error}); delete it and generate again to remake it"
        ) from error


def remove_partial(folder: Path) -> None:
    """Remove files that killed processes left half-written in ``folder``."""
    for path in folder.glob(".*.partial"):
        path.unlink(missing_ok=True)
