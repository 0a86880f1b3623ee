"""Journal of a search: a file of all expanded states, from which a killed run continues."""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import torch

from scene_envs.envs import MaskChoiceState, SearchState
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.scene import SceneBatch

_MAGIC = b"scene-envs search 1\n"
_HEAD = struct.Struct("<II")
"""Length and CRC-32 of a record."""


class Journal:
    """A file of records: the settings of the search, then the states of every round, in order.

    A record that was being written when the process was killed is dropped.

    Args:
        path: journal file, created if it does not exist.
        settings: settings on which the states depend, by name.

    Raises:
        InvalidInputError: the file was made with other settings.
        CorruptFileError: the file is no journal, or is damaged before its end.
    """

    def __init__(self, path: str | os.PathLike[str], settings: Mapping[str, Any]) -> None:
        self.path = Path(path)
        self._states: list[SearchState] = []
        self._taken = 0
        settings = {key: _described(value) for key, value in settings.items()}
        if self.path.exists() and self.path.stat().st_size:
            self._read(settings)
        else:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._begin(settings)

    def __len__(self) -> int:
        """Number of states that an earlier run wrote."""
        return len(self._states)

    def take(self, pairs: Sequence[tuple[SearchState, int]]) -> list[SearchState]:
        """The states that an earlier run made for the first of ``pairs``; as many as the file still has.

        Raises:
            InvalidInputError: the earlier run made states of other pairs.
        """
        known = self._states[self._taken : self._taken + len(pairs)]
        for (parent, action), state in zip(pairs, known, strict=False):
            if (state.seed, state.path) != (parent.seed, (*parent.path, action)):
                raise InvalidInputError(
                    f"{self.path} holds another search: path {state.path} where this one asks for "
                    f"{(*parent.path, action)}; give another output"
                )
        self._taken += len(known)
        return known

    def add(self, states: Sequence[SearchState]) -> None:
        """Write the states of a round."""
        self._append([{field.name: getattr(state, field.name) for field in fields(state)} for state in states])

    def states(self) -> Iterator[SearchState]:
        """All states in the file, in order, with one round in memory at a time."""
        with self.path.open("rb") as file:
            for record in islice(self._records(file), 1, None):
                yield from map(_state, record)

    def _begin(self, settings: Mapping[str, str]) -> None:
        self.path.write_bytes(_MAGIC)
        self._append(settings)

    def _append(self, content: Any) -> None:
        buffer = io.BytesIO()
        torch.save(content, buffer)
        record = buffer.getvalue()
        with self.path.open("ab") as file:
            file.write(_HEAD.pack(len(record), zlib.crc32(record)) + record)
            file.flush()

    def _read(self, settings: Mapping[str, str]) -> None:
        records = []
        with self.path.open("r+b") as file:
            begun = file.read(len(_MAGIC))
            if not _MAGIC.startswith(begun):
                raise CorruptFileError(f"{self.path} is no journal of a search; remove it, or give another output")
            whole = len(begun)
            for record in self._records(file):
                records.append(record)
                whole = file.tell()
            file.truncate(whole)  # a process was killed while writing the rest
        if not records:  # killed before the first record was complete
            self._begin(settings)
            return
        for name in sorted({*settings, *records[0]}):
            before, now = records[0].get(name), settings.get(name)
            if before != now:
                raise InvalidInputError(
                    f"{self.path} holds a search with {name}={before}, not {now}; give another output, or that value"
                )
        self._states = [_state(values) for states in records[1:] for values in states]

    def _records(self, file: BinaryIO) -> Iterator[Any]:
        """The complete records; the file is positioned behind the record that is yielded."""
        file.seek(len(_MAGIC))
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum = _HEAD.unpack(head)
            record = file.read(length)
            if len(record) < length:
                return
            if zlib.crc32(record) != checksum:
                start = file.tell() - length - _HEAD.size
                raise CorruptFileError(f"{self.path} is damaged at byte {start}; remove it, or give another output")
            yield torch.load(io.BytesIO(record), weights_only=True)


def _state(values: Mapping[str, Any]) -> SearchState:
    return MaskChoiceState(**values) if "masks" in values else SearchState(**values)


def _described(value: Any) -> str:
    """A setting as text, the same in every process.

    A prior is described by its weights, an object with an attribute ``described_by`` by the value of this attribute, a
    dataclass by its class and the fields that differ from the defaults, and other objects by their class alone.
    """
    if isinstance(value, str | int | float | bool | None):
        return repr(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_described(value[key])}" for key in sorted(value)) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_described, value)) + "]"
    if isinstance(value, SceneBatch):
        content = value.tensor.contiguous().numpy().tobytes()
        return f"{len(value)} scenes {hashlib.blake2b(content, digest_size=8).hexdigest()}"
    if hasattr(value, "weights"):
        digest = hashlib.blake2b(digest_size=8)
        for name, tensor in sorted(value.weights().items()):
            digest.update(name.encode() + tensor.detach().cpu().contiguous().numpy().tobytes())
        return f"weights {digest.hexdigest()}"
    if hasattr(value, "described_by"):
        return _described(value.described_by)
    kind = value if hasattr(value, "__qualname__") else type(value)
    name = f"{kind.__module__}.{kind.__qualname__}"
    if isinstance(value, type) or not is_dataclass(value):
        return name
    settings = {
        field.name: getattr(value, field.name)
        for field in fields(value)
        if field.init and field.compare and getattr(value, field.name) != field.default
    }
    return f"{name}{_described(settings)}" if settings else name
