"""Dataset file reader: parquet and arrow, whole or block by block, in any list layout."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from scene_envs.datasets.store import METADATA, PROMPTS, PROMPT_SETS, SCENES, open_parquet
from scene_envs.errors import CorruptFileError, InvalidInputError

_STATE, _SPLITS = "state.json", "dataset_dict.json"
_SUFFIXES = (".parquet", ".arrow")
BLOCK = 2000
"""Scenes per block at most."""


@dataclass(frozen=True)
class Block:
    """A run of rows of one file: the unit that is read at a time."""

    file: Path  # parquet or arrow file
    start: int  # first row of the block
    rows: int  # number of rows
    group: int = -1  # row group of a parquet file that holds the block; -1 for arrow
    skip: int = 0  # number of rows of the group before the block


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a file, unchanged."""

    scenes: NDArray[np.floating]  # (M, N, D) float32 or float64, normalised
    prompt_sets: list[tuple[str, ...]]  # M tuples of prompts, at least one each
    place: str  # name of the file, for messages
    start: int  # row of the first scene in the file


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """The data files of a dataset, in order.

    ``path`` is a parquet or arrow file, a folder of them (or with them in ``data/``), or what
    ``datasets.Dataset.save_to_disk`` wrote.

    Raises:
        InvalidInputError: there are no such files.
        CorruptFileError: ``state.json`` cannot be read, or names missing files.
    """
    path = Path(path)
    if path.is_file():
        if path.suffix not in _SUFFIXES:
            raise InvalidInputError(f"{str(path)!r} is neither a .parquet nor an .arrow file")
        return [path]
    if (path / _SPLITS).is_file():
        splits = sorted(folder.name for folder in path.iterdir() if folder.is_dir())
        raise InvalidInputError(f"{str(path)!r} holds the splits {splits}; give one of them, as in {splits[:1]}")
    if (path / _STATE).is_file():
        return _saved_files(path)
    for folder in (path, path / "data"):
        files = [file for suffix in _SUFFIXES for file in folder.glob(f"[!.]*{suffix}")]
        files = sorted(file for file in files if not file.name.startswith("cache-"))
        if files:
            return files
    raise InvalidInputError(f"no parquet or arrow files at {str(path)!r}; give a dataset folder or such a file")


def find_metadata(path: str | os.PathLike[str]) -> Path:
    """``metadata.json`` in the folder of a dataset or file, or in the folder above (splits share one).

    Without such a file, the result is its expected path in the folder.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    above = folder.parent / METADATA
    return above if above.is_file() and not (folder / METADATA).is_file() else folder / METADATA


def list_blocks(file: Path) -> list[Block]:
    """The blocks of one file, found without reading its scenes; raises CorruptFileError."""
    if file.suffix == ".arrow":
        return _cut(file, _arrow_table(file).num_rows)
    metadata = open_parquet(file).metadata
    blocks: list[Block] = []
    start = 0
    for group in range(metadata.num_row_groups):
        rows = metadata.row_group(group).num_rows
        blocks += _cut(file, rows, start, group)
        start += rows
    return blocks


def read_block(block: Block, features: int) -> Rows:
    """The rows of a block whose slots have ``features`` features (D) in the file.

    Raises:
        CorruptFileError: it cannot be read, columns are missing, or scenes have another width or gaps.
    """
    try:
        if block.file.suffix == ".arrow":
            table = _arrow_table(block.file)
            present = _columns(table.column_names, str(block.file))
            return to_rows(table.slice(block.start, block.rows).select(present), features, str(block.file), block.start)
        parquet = open_parquet(block.file)
        present = _columns(parquet.schema_arrow.names, str(block.file))
        table = _within_group(parquet.iter_batches(BLOCK, row_groups=[block.group], columns=present), block)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptFileError(
            f"cannot read rows {block.start} to {block.start + block.rows - 1} of {str(block.file)!r}: {error}; "
            "delete the file and generate again to remake it"
        ) from error
    return to_rows(table, features, str(block.file), block.start)


def to_rows(table: pa.Table, features: int, place: str, start: int = 0) -> Rows:
    """Scenes and prompts of a table with the columns of a dataset.

    ``scenes`` may be lists of lists, fixed-size lists, Hugging Face ``Array2D``, or one flat list per scene, of
    half, single or double floats.

    Raises:
        CorruptFileError: columns are missing, or scenes are ragged, incomplete or of another width.
    """
    _columns(table.column_names, place)
    try:
        scenes = _to_array(_one_array(table[SCENES]), features, start)
        prompt_sets = _prompt_sets(table)
    except (pa.ArrowException, ValueError) as error:
        raise CorruptFileError(
            f"cannot read scenes of {features} features per slot from {place!r}: {error}; "
            "delete the file and generate again to remake it"
        ) from error
    return Rows(scenes, prompt_sets, place, start)


def _saved_files(folder: Path) -> list[Path]:
    path = folder / _STATE
    try:
        names = [entry["filename"] for entry in json.loads(path.read_text())["_data_files"]]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise CorruptFileError(f"{str(path)!r} does not list the data files of a saved dataset: {error}") from error
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise CorruptFileError(f"{str(path)!r} lists missing files: {missing}")
    return [folder / name for name in names]


def _arrow_table(file: Path) -> pa.Table:
    """The table of an arrow file, of the stream or the file format, mapped into memory rather than read."""
    try:
        source = pa.memory_map(str(file))
        try:
            return pa.ipc.open_file(source).read_all()
        except pa.ArrowInvalid:
            source.seek(0)
            return pa.ipc.open_stream(source).read_all()
    except FileNotFoundError:
        raise InvalidInputError(f"no arrow file at {str(file)!r}") from None
    except (pa.ArrowException, OSError) as error:
        raise CorruptFileError(f"{str(file)!r} is not a readable arrow file ({error}); fetch it again") from error


def _cut(file: Path, rows: int, start: int = 0, group: int = -1) -> list[Block]:
    return [
        Block(file, start + skip, min(BLOCK, rows - skip), group, skip if group >= 0 else 0)
        for skip in range(0, rows, BLOCK)
    ]


def _within_group(batches: Iterator[pa.RecordBatch], block: Block) -> pa.Table:
    """The block's rows from the batches of its row group."""
    parts, seen = [], 0
    for batch in batches:
        low, high = max(block.skip - seen, 0), min(block.skip + block.rows - seen, batch.num_rows)
        if low < high:
            parts.append(batch.slice(low, high - low))
        seen += batch.num_rows
        if seen >= block.skip + block.rows:
            break
    return pa.Table.from_batches(parts)


def _columns(names: Sequence[str], place: str) -> list[str]:
    """Names of the columns that are read from a file with the columns ``names``."""
    missing = [name for name in (SCENES, PROMPTS) if name not in names]
    if missing:
        raise CorruptFileError(f"{place!r} lacks the column(s) {missing}; it has {list(names)}")
    return [name for name in (SCENES, PROMPTS, PROMPT_SETS) if name in names]


def _prompt_sets(table: pa.Table) -> list[tuple[str, ...]]:
    column = PROMPT_SETS if PROMPT_SETS in table.column_names else PROMPTS
    first = table[PROMPTS].to_pylist()
    sets = []
    for one, texts in zip(first, table[column].to_pylist(), strict=True):
        listed = texts if isinstance(texts, list) else [texts]
        sets.append(tuple(text or "" for text in listed) or (one if isinstance(one, str) else "",))
    return sets


def _one_array(column: pa.ChunkedArray) -> pa.Array:
    """The column as one array; extension types (``Array2D`` of Hugging Face ``datasets``) give their storage."""
    chunks = [chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk for chunk in column.chunks]
    if not chunks:
        kind = column.type.storage_type if isinstance(column.type, pa.BaseExtensionType) else column.type
        return pa.array([], kind)
    return pa.concat_arrays(chunks)


def _to_array(column: pa.Array, features: int, start: int) -> NDArray[np.floating]:
    """Lists of M scenes as (M, N, D); raises ValueError when they are ragged, have gaps or another width."""
    count = len(column)
    if count == 0:
        return np.empty((0, 0, features), dtype=np.float32)
    _check_complete(column, start, "scene")
    sizes = np.asarray(pc.list_value_length(column))
    inner = pc.list_flatten(column)
    if pa.types.is_list(inner.type) or pa.types.is_large_list(inner.type) or pa.types.is_fixed_size_list(inner.type):
        _check_complete(inner, start, "slot", int(sizes.max(initial=1)))
        widths = np.asarray(pc.list_value_length(inner))
        inner = pc.list_flatten(inner)
    else:  # one flat list per scene
        widths = np.full(1, features if (sizes % features == 0).all() else int(sizes[0]))
        sizes = sizes // features
    if (widths != features).any() or (sizes != sizes[0]).any():
        slots, found = sorted(set(sizes.tolist())), sorted(set(widths.tolist()))
        raise ValueError(f"slots per scene {slots[:5]}, features per slot {found[:5]}, expected {features} features")
    if inner.null_count:
        row = start + int(np.flatnonzero(np.asarray(inner.is_null()))[0]) // (int(sizes[0]) * features)
        raise ValueError(f"row {row} has a missing value")
    if not pa.types.is_floating(inner.type):
        raise ValueError(f"values are {inner.type}, expected floats")
    values = inner.to_numpy(zero_copy_only=False)
    if values.dtype == np.float16:
        values = values.astype(np.float32)
    return values.reshape(count, int(sizes[0]), features)


def _check_complete(lists: pa.Array, start: int, what: str, per_row: int = 1) -> None:
    if not (
        pa.types.is_list(lists.type) or pa.types.is_large_list(lists.type) or pa.types.is_fixed_size_list(lists.type)
    ):
        raise ValueError(f"column {SCENES!r} holds {lists.type}, expected lists of floats")
    if lists.null_count:
        row = start + int(np.flatnonzero(np.asarray(lists.is_null()))[0]) // per_row
        raise ValueError(f"row {row} has a missing {what}")
