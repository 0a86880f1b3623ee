"""Files of a dataset: parquet shards of normalised scenes and prompts, and one ``metadata.json``.

The layout is that of the published datasets: column ``scenes`` holds normalised (N, D) float32 scenes,
``language_annotation`` one prompt each; ``metadata.json`` names the assets and holds the normalizer.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType

METADATA = "metadata.json"
SCENES = "scenes"
PROMPTS = "language_annotation"
_NOTES = b"scene_envs"
_MODEL_PATH = "scene_envs/assets/{name}"


def shard_name(index: int) -> str:
    """File name of shard ``index``."""
    return f"scenes-{index:05d}.parquet"


def make_metadata(scene_type: SceneType, normalizer: Normalizer, **extra: Any) -> dict[str, Any]:
    """The content of ``metadata.json`` for a dataset of ``scene_type``; ``extra`` keys are added as they are."""
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


def _partial(path: Path) -> Path:
    """Where ``path`` is written before it takes its name; one place per process, so that two never mix."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


def remove_partial(folder: Path) -> None:
    """Remove what killed processes left half-written in ``folder``."""
    for path in folder.glob(".*.partial"):
        path.unlink(missing_ok=True)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically."""
    partial = _partial(path)
    partial.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(partial, path)


def read_metadata(path: Path) -> dict[str, Any]:
    """Read ``metadata.json`` at ``path`` and check that the keys every reader needs are there.

    Raises:
        InvalidInputError: there is no such file.
        CorruptFileError: it is not JSON, or lacks keys (they are named).
    """
    if not path.is_file():
        raise InvalidInputError(f"no {METADATA} at {str(path)!r}; a dataset folder holds one beside its parquet files")
    try:
        metadata = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{str(path)!r} is not valid JSON: {error}") from error
    needed = ("model_paths", "normalizer_state")
    missing = [key for key in needed if not isinstance(metadata, dict) or key not in metadata]
    if missing:
        raise CorruptFileError(f"{str(path)!r} lacks the keys {missing}; a dataset's metadata needs {list(needed)}")
    return dict(metadata)


def write_shard(path: Path, scenes: NDArray[np.float32], prompts: Sequence[str], notes: Mapping[str, Any]) -> None:
    """Write one parquet file atomically.

    Args:
        path: where to.
        scenes: (M, N, D) float32, normalised.
        prompts: M prompts.
        notes: JSON-able facts kept in the file's footer, such as why scenes were thrown away.
    """
    count, slots, features = scenes.shape
    values = pa.array(np.ascontiguousarray(scenes).reshape(-1))
    rows = pa.ListArray.from_arrays(pa.array(np.arange(count * slots + 1, dtype=np.int32) * features), values)
    column = pa.ListArray.from_arrays(pa.array(np.arange(count + 1, dtype=np.int32) * slots), rows)
    table = pa.table({SCENES: column, PROMPTS: pa.array(list(prompts), pa.string())})
    table = table.replace_schema_metadata({_NOTES: json.dumps(notes, sort_keys=True).encode()})
    partial = _partial(path)
    pq.write_table(table, partial, compression="zstd")
    os.replace(partial, path)


def read_notes(path: Path) -> dict[str, Any]:
    """The facts that :func:`write_shard` kept in the footer; empty for files of others."""
    footer = _open(path).schema_arrow.metadata or {}
    return dict(json.loads(footer.get(_NOTES, b"{}")))


def read_shard(path: Path, features: int) -> tuple[NDArray[np.float32], list[str]]:
    """Scenes (M, N, D), normalised, and M prompts of one parquet file.

    Raises:
        CorruptFileError: not a parquet file, truncated, columns missing, or scenes of the wrong shape.
    """
    file = _open(path)
    columns = file.schema_arrow.names
    missing = [name for name in (SCENES, PROMPTS) if name not in columns]
    if missing:
        raise CorruptFileError(f"{str(path)!r} lacks the column(s) {missing}; it has {columns}")
    try:
        table = file.read([SCENES, PROMPTS])
        scenes = _to_array(table[SCENES].combine_chunks(), features)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptFileError(
            f"cannot read scenes of {features} features per slot from {str(path)!r}: {error}; "
            "delete the file and generate again to remake it"
        ) from error
    return scenes, [text or "" for text in table[PROMPTS].to_pylist()]


def _open(path: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise InvalidInputError(f"no parquet file at {str(path)!r}") from None
    except (pa.ArrowException, OSError) as error:
        raise CorruptFileError(
            f"{str(path)!r} is not a readable parquet file ({error}); delete it and generate again to remake it"
        ) from error


def _to_array(column: pa.Array, features: int) -> NDArray[np.float32]:
    """Nested lists (M of N of D) as (M, N, D); raises ValueError when they are ragged or of another width."""
    if isinstance(column, pa.ChunkedArray):
        column = pa.concat_arrays(column.chunks) if column.num_chunks else pa.array([], column.type)
    if isinstance(column, pa.ExtensionArray):  # Array2D of Hugging Face `datasets`
        column = column.storage
    values = column.flatten().flatten().to_numpy(zero_copy_only=False).astype(np.float32, copy=False)
    count = len(column)
    if count == 0:
        return np.empty((0, 0, features), dtype=np.float32)
    widths = np.asarray(column.flatten().value_lengths())
    heights = np.asarray(column.value_lengths())
    if (widths != features).any() or (heights != heights[0]).any():
        found = sorted(set(heights.tolist())), sorted(set(widths.tolist()))
        raise ValueError(f"slots per scene {found[0]}, features per slot {found[1]}, expected {features} features")
    return values.reshape(count, int(heights[0]), features)
