"""Files of datasets: shards and metadata as they are written, and parquet and arrow files in any list layout."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.files import read_json, replacing, with_digest, without_digest, write_json, write_text
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE_FEATURES
from scene_envs.scene_types import SceneType

METADATA = "metadata.json"
SCENES = "scenes"
PROMPTS = "language_annotation"
PROMPT_SETS = "language_annotations"
_NOTES = b"scene_envs"
_MODEL_PATH = "scene_envs/assets/{name}"
_ROW_GROUP = 500
"""Scenes per row group, the unit that a streaming reader holds in memory."""
_BLOCK = 2000
"""Largest number of scenes that are read at a time."""
_STATE, _SPLITS = "state.json", "dataset_dict.json"
_SUFFIXES = (".parquet", ".arrow")
_REMEDY = "delete it and generate again to remake it"


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


_CARD = """---
configs:
- config_name: default
  data_files: "*.parquet"
---

# Scenes of {scene_type}

Each row is a scene: `scenes` (slots x features, normalised as `metadata.json` says), `language_annotation` (one
prompt) and `language_annotations` (all of them). `SceneDataset.load` of SceneEnvs reads this folder, and so does
`load_dataset` of Hugging Face.
"""


def write_metadata(folder: Path, metadata: dict[str, Any]) -> None:
    """``metadata.json``, and a dataset card (``README.md``) that names the data files to Hugging Face ``datasets``."""
    card = folder / "README.md"
    if not card.exists():
        write_text(card, _CARD.format(scene_type=metadata["scene_type"]))
    write_json(folder / METADATA, with_digest(metadata), indent=2)


def write_bytes(path: Path, content: bytes) -> None:
    """Write one file, whole or not at all; raises :class:`StorageError`."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def encode_shard(
    scenes: NDArray[np.float32], prompt_sets: Sequence[tuple[str, ...]], notes: Mapping[str, Any]
) -> bytes:
    """The bytes of the parquet file of M scenes (M, N, D), normalised; equal for equal arguments.
    ``language_annotations`` is left out when every scene has one prompt; ``notes`` go to the file's footer as JSON.
    """
    count, slots, features = scenes.shape
    values = pa.array(np.ascontiguousarray(scenes).reshape(-1))
    rows = pa.ListArray.from_arrays(pa.array(np.arange(count * slots + 1, dtype=np.int32) * features), values)
    columns: dict[str, pa.Array] = {
        SCENES: pa.ListArray.from_arrays(pa.array(np.arange(count + 1, dtype=np.int32) * slots), rows),
        PROMPTS: pa.array([prompts[0] for prompts in prompt_sets], pa.string()),
    }
    if any(len(prompts) > 1 for prompts in prompt_sets):
        columns[PROMPT_SETS] = pa.array([list(prompts) for prompts in prompt_sets], pa.list_(pa.string()))
    sums = _checksums((0, 0), scenes, prompt_sets)
    kept = json.dumps(with_digest({**notes, "rows": count, "checksums": sums}), sort_keys=True)
    table = pa.table(columns).replace_schema_metadata({_NOTES: kept.encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=_ROW_GROUP, write_page_checksum=True)
    return bytes(sink.getvalue().to_pybytes())


def _checksums(before: Sequence[int], scenes: NDArray[Any], prompt_sets: Sequence[tuple[str, ...]]) -> list[int]:
    """CRC-32 of scenes and of prompts of all rows so far. Those of parquet leave out headers of pages and footer."""
    texts = "".join(f"{prompt}\0" for prompts in prompt_sets for prompt in (*prompts, ""))
    return [zlib.crc32(np.ascontiguousarray(scenes).data, before[0]), zlib.crc32(texts.encode(), before[1])]


@contextmanager
def _reading(problem: str, remedy: str = _REMEDY) -> Iterator[None]:
    """Context in which an error of arrow is a CorruptFileError that names the ``problem`` and the ``remedy``."""
    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:
        raise CorruptFileError(f"{problem} ({str(error)[:200]}); {remedy}") from error


def read_notes(path: Path, file: pq.ParquetFile | None = None) -> dict[str, Any]:
    """The facts that :func:`encode_shard` kept in the footer, ``rows`` and ``checksums``, of the open ``file`` if
    it is given; raises CorruptFileError.
    """
    file = file or open_parquet(path)
    footer = file.schema_arrow.metadata or {}
    rows = file.metadata.num_rows
    with _reading(f"{str(path)!r} has a damaged footer"):
        try:
            notes = without_digest(json.loads(footer.get(_NOTES, b"{}")), path)
        except (TypeError, AttributeError, CorruptFileError) as error:
            raise ValueError(error) from error
        if notes.get("rows", rows) != rows:
            raise ValueError(f"{notes['rows']} rows were written, the file has {rows}")
    return {**notes, "rows": rows}


def open_parquet(path: Path) -> pq.ParquetFile:
    """The parquet file at ``path``; raises InvalidInputError (none there) or CorruptFileError."""
    if not path.exists():
        raise InvalidInputError(f"no parquet file at {str(path)!r}")
    with _reading(f"{str(path)!r} is not a readable parquet file"):
        file = pq.ParquetFile(path, page_checksum_verification=True)
        _ = file.schema_arrow.names, file.metadata.num_rows  # reading these raises when they are damaged
        return file


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of a file, unchanged."""

    scenes: NDArray[np.floating]  # (M, N, D) float32 or float64, normalised
    prompt_sets: list[tuple[str, ...]]  # M tuples of prompts, at least one each
    place: str  # name of the file, for messages
    start: int  # row of the first scene in the file


def find_files(path: str | os.PathLike[str]) -> list[Path]:
    """The data files of a dataset, in order: ``path`` is a parquet or arrow file, a folder of them (or with them in
    ``data/``), or what ``datasets.Dataset.save_to_disk`` wrote. Raises InvalidInputError where there are none, and
    CorruptFileError for a ``state.json`` that cannot be read or names missing files.
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
    """``metadata.json`` in the folder of a dataset or file, or in the folder above (splits share one); without such a
    file, its expected path in the folder.
    """
    path = Path(path)
    folder = path if path.is_dir() else path.parent
    above = folder.parent / METADATA
    return above if above.is_file() and not (folder / METADATA).is_file() else folder / METADATA


def read_rows(file: Path, features: int) -> Iterator[Rows]:
    """The rows of one file of D = ``features`` features per slot, a block at a time. Scenes may be lists of lists,
    fixed-size lists, Hugging Face ``Array2D``, or one flat list per scene, of half, single or double floats. Raises
    CorruptFileError where the file cannot be read, columns are missing, or scenes have another width or gaps, and at
    the end of a file of this package whose rows are not those that were written.
    """
    place, start, sums, notes = str(file), 0, [0, 0], {}
    if file.suffix == ".arrow":
        table = _arrow_table(file)
        batches = iter(table.select(_columns(table.column_names, place)).to_batches(_BLOCK))
    else:
        parquet = open_parquet(file)
        notes = read_notes(file, parquet)
        batches = parquet.iter_batches(_BLOCK, columns=_columns(parquet.schema_arrow.names, place))
    while True:
        with _reading(f"cannot read {place!r} from row {start} on"):
            batch = next(batches, None)
        if batch is None:
            if notes.get("checksums", sums) != sums:
                raise CorruptFileError(
                    f"{place!r} is damaged: its rows are not those that were written; {_REMEDY}. If they were changed "
                    "on purpose, write the file without the metadata of its schema"
                )
            return
        if not batch.num_rows:
            continue
        with _reading(f"cannot read scenes of {features} features per slot from {place!r}"):
            scenes, prompt_sets = _to_array(batch[SCENES], features, start), _prompt_sets(batch)
        sums = _checksums(sums, scenes, prompt_sets)
        yield Rows(scenes, prompt_sets, place, start)
        start += batch.num_rows


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
    if not file.exists():
        raise InvalidInputError(f"no arrow file at {str(file)!r}")
    with _reading(f"{str(file)!r} is not a readable arrow file", "fetch it again"):
        source = pa.memory_map(str(file))
        try:
            return pa.ipc.open_file(source).read_all()
        except pa.ArrowInvalid:
            source.seek(0)
            return pa.ipc.open_stream(source).read_all()


def _columns(names: Sequence[str], place: str) -> list[str]:
    """Names of the columns that are read from a file with the columns ``names``."""
    missing = [name for name in (SCENES, PROMPTS) if name not in names]
    if missing:
        raise CorruptFileError(f"{place!r} lacks the column(s) {missing}; it has {list(names)}")
    return [name for name in (SCENES, PROMPTS, PROMPT_SETS) if name in names]


def _prompt_sets(batch: pa.RecordBatch) -> list[tuple[str, ...]]:
    first = batch[PROMPTS].to_pylist()
    column = batch[PROMPT_SETS].to_pylist() if PROMPT_SETS in batch.schema.names else first
    sets = []
    for one, texts in zip(first, column, strict=True):
        listed = texts if isinstance(texts, list) else [texts]
        sets.append(tuple(text or "" for text in listed) or (one if isinstance(one, str) else "",))
    return sets


def _to_array(column: pa.Array, features: int, start: int) -> NDArray[np.floating]:
    """Lists of M scenes as (M, N, D); raises ValueError when they are ragged, have gaps or another width."""
    if isinstance(column, pa.ExtensionArray):  # ``Array2D`` of Hugging Face ``datasets``
        column = column.storage
    _check_complete(column, start, "scene")
    sizes = np.asarray(pc.list_value_length(column))
    inner = pc.list_flatten(column)
    if _is_list(inner):
        _check_complete(inner, start, "slot", int(sizes.max(initial=1)))
        widths = np.asarray(pc.list_value_length(inner))
        inner = pc.list_flatten(inner)
    else:  # one flat list per scene
        widths = np.full(1, features if (sizes % features == 0).all() else int(sizes[0]))
        sizes = sizes // features
    if (widths != features).any() or (sizes != max(1, sizes[0])).any():
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
    return values.reshape(len(column), int(sizes[0]), features)


def _is_list(column: pa.Array) -> bool:
    kinds = pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list
    return any(is_kind(column.type) for is_kind in kinds)


def _check_complete(lists: pa.Array, start: int, what: str, per_row: int = 1) -> None:
    if not _is_list(lists):
        raise ValueError(f"column {SCENES!r} holds {lists.type}, expected lists of floats")
    if lists.null_count:
        row = start + int(np.flatnonzero(np.asarray(lists.is_null()))[0]) // per_row
        raise ValueError(f"row {row} has a missing {what}")


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
        metadata: All keys of the file but the digest.
    """

    path: Path
    model_paths: tuple[str, ...]
    normalizer: Normalizer
    welded_model_paths: tuple[str, ...] = ()
    slots: int | None = None
    scene_type: str | None = None
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
        ``aliases`` maps model paths, or their stems, to asset names. Raises UnknownNameError for a model path that is
        no asset of the scene type, which may have assets that the files lack.
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
    metadata = read_json(file)
    needed = ("model_paths", "normalizer_state")
    missing = [key for key in needed if key not in metadata]
    if missing:
        raise CorruptFileError(f"{str(file)!r} lacks the keys {missing}; a dataset's metadata needs {list(needed)}")
    for key in ("model_paths", "welded_object_model_paths"):
        if not isinstance(metadata.get(key) or [], list):
            raise CorruptFileError(f"{str(file)!r}: {key} must be a list of paths, it is {str(metadata[key])[:100]}")
    paths = tuple(map(str, metadata["model_paths"] or ()))
    try:
        normalizer = Normalizer.from_state(metadata["normalizer_state"])
        number = metadata.get("max_num_objects_per_scene")
        slots = None if number is None else int(number)
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
        metadata=metadata,
    )


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
