"""Limits on the size of a user's model file and on the time that its import takes."""

from __future__ import annotations

import json
import math
import os
import re
import struct
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import dataclass, fields
from pathlib import Path
from threading import Thread
from typing import Any, TypeVar

from scene_envs.errors import InvalidInputError

Result = TypeVar("Result")
_PREFIX = "SCENE_ENVS_IMPORT_"
_GRACE = 1.0
"""Additional seconds for work that checks the time itself."""
_HEAD = 1 << 16
"""Number of bytes at the start of a mesh file that are searched for its header."""
READ_HERE = 300_000
"""Largest number of bytes of files that are imported in the calling process, by a thread that is abandoned at the time
limit. A larger import runs in a process of its own, which is ended at the time limit."""
_BYTES_PER_TRIANGLE = 36


class LargeImportError(BaseException):
    """An import reads more than :data:`READ_HERE`; no Exception, so that it is not taken for an error of the file."""


@dataclass
class _Clock:
    """The import of one asset."""

    path: Path  # file of the asset
    end: float  # time of the monotonic clock at which the import must be done
    seconds: float  # time limit of the import
    room: float  # bytes of files that the import may still read in this process


_clock: ContextVar[_Clock | None] = ContextVar("import_clock", default=None)


@dataclass(frozen=True)
class ImportLimits:
    """Limits for each file of a user's assets.

    The environment variables ``SCENE_ENVS_IMPORT_MEGABYTES``, ``SCENE_ENVS_IMPORT_TRIANGLES`` and
    ``SCENE_ENVS_IMPORT_SECONDS`` replace the defaults. The folder cannot set them, because its source may be untrusted.
    """

    megabytes: float = 256.0  # size of a file, 10⁶ bytes
    triangles: float = 1e6  # of a mesh file (or corners), from its header or content
    seconds: float = 300.0  # for reading, decomposing and weighing one asset

    @classmethod
    def current(cls) -> ImportLimits:
        """The limits, with the environment variables that are set; InvalidInputError for one that is not positive."""
        chosen = {}
        for field in fields(cls):
            text = os.environ.get(_PREFIX + field.name.upper())
            if text is None:
                continue
            try:
                chosen[field.name] = float(text)
            except ValueError:
                chosen[field.name] = math.nan
            if not chosen[field.name] > 0:
                raise InvalidInputError(f"{_PREFIX}{field.name.upper()}={text[:50]!r} must be a positive number")
        return cls(**chosen)


def check_file(path: Path) -> None:
    """Refuse a file that is larger, or whose header states more triangles, than the limits, by InvalidInputError; raise
    LargeImportError where the running import must move to a process of its own.
    """
    limits = ImportLimits.current()
    try:
        size = path.stat().st_size
    except OSError:
        return  # the reader of the file raises the error
    if size > limits.megabytes * 1e6:
        raise InvalidInputError(
            f"{path} has {size / 1e6:,.0f} MB, more than the {limits.megabytes:g} MB that one file of an asset may "
            f"have; simplify it, or set {_PREFIX}MEGABYTES"
        )
    stated = _stated_triangles(path, size)
    check_triangles(path, stated)
    if (clock := _clock.get()) is not None:
        clock.room -= max(size, _BYTES_PER_TRIANGLE * stated)
        if clock.room < 0:
            raise LargeImportError


def check_triangles(path: Path, count: int) -> None:
    """Refuse a file of too many triangles; raises as :func:`check_file` does."""
    limit = ImportLimits.current().triangles
    if count > limit:
        raise InvalidInputError(
            f"{path} has {count:,} triangles, more than the {limit:,.0f} that one mesh file may have; simplify it, or "
            f"set {_PREFIX}TRIANGLES"
        )


@contextmanager
def timed(path: Path, room: float = math.inf) -> Iterator[None]:
    """Context in which the time of the import of the asset at ``path`` runs; see :func:`seconds_left`.
    :func:`check_file` raises LargeImportError for files of more than ``room`` bytes together.
    """
    seconds = ImportLimits.current().seconds
    token = _clock.set(_Clock(path, time.monotonic() + seconds, seconds, room))
    try:
        yield
    finally:
        _clock.reset(token)


def seconds_left() -> float | None:
    """Seconds until the running import has to be done, None when none runs; InvalidInputError when the time is over."""
    clock = _clock.get()
    if clock is None:
        return None
    left = clock.end - time.monotonic()
    if left <= 0:
        raise too_slow("")
    return left


def in_time(work: Callable[[], Result]) -> Result:
    """The result of ``work``. Raises its exceptions, and InvalidInputError when the running import is out of time.

    Work that takes longer goes on in a thread of its own, which ends at the next :func:`seconds_left`. Work that checks
    the time itself, such as CoACD's, gets one more second, in which it can report the slow step.
    """
    outcome: Future[Result] = Future()
    context = copy_context()

    def run() -> None:
        try:
            outcome.set_result(context.run(work))
        except BaseException as error:
            outcome.set_exception(error)

    left = seconds_left()
    Thread(target=run, name="asset import", daemon=True).start()
    if not wait([outcome], None if left is None else left + _GRACE).done:
        raise too_slow("")
    return outcome.result()


def too_slow(doing: str) -> InvalidInputError:
    """The error for an import that took too long; ``doing`` names its last step."""
    clock = _clock.get()
    path = Path("the mesh") if clock is None else clock.path
    seconds = ImportLimits.current().seconds if clock is None else clock.seconds
    return InvalidInputError(
        f"{path}: the import took longer than {seconds:g} s{doing and ', '}{doing}; simplify the mesh, set "
        f"`decomposition: convex` for it, or set {_PREFIX}SECONDS"
    )


def _stated_triangles(path: Path, size: int) -> int:
    """Number of triangles or corners that the header of a mesh file states, 0 without one."""
    suffix = path.suffix.lower()
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
        if suffix in (".glb", ".gltf"):
            accessors = gltf_header(path.read_bytes(), suffix == ".glb")["accessors"]
            return max((int(accessor["count"]) for accessor in accessors), default=0) // 3
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return 0  # the reader of the file raises the error
    if suffix == ".obj":
        return path.read_bytes().count(b"\nf ")
    if suffix == ".stl":
        stated = struct.unpack("<I", head[80:84])[0] if len(head) >= 84 else 0
        is_text = size < 84 + 50 * stated and head.startswith(b"solid")
        return path.read_bytes().count(b"facet normal") if is_text else stated
    if suffix == ".ply":
        counts = re.findall(rb"^element\s+\w+\s+(\d{1,30})", head.partition(b"end_header")[0], re.MULTILINE)
        return max(map(int, counts), default=0)
    if suffix == ".off":
        words = [word for line in head.splitlines()[:100] if not line.startswith(b"#") for word in line.split()]
        return max((int(word) for word in words[1:3] if word.isdigit() and len(word) < 30), default=0)
    return 0


def gltf_header(data: bytes, is_binary: bool) -> Any:
    """The JSON of a glTF file, or of a GLB; ValueError for none."""
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")] if is_binary else data)
