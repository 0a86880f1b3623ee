"""Atomic file writes, and JSON without non-finite numbers."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A file to write beside ``path``, which takes the name ``path`` when the block ends without an error.

    The folder is made if need be. What is written at first has a hidden name, ``.<name>.<process>.partial``, so that
    processes never mix; it is removed when the block fails, and what was at ``path`` before is untouched.

    Raises:
        OSError: the operating system refused to write or to rename.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / "new" / "a.txt") as partial:
    ...         _ = partial.write_text("all of it")
    ...     [path.name for path in (Path(folder) / "new").iterdir()]
    ['a.txt']
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Replace the file at ``path`` by ``text`` in UTF-8; errors as for :func:`replacing`."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], content: Any, *, indent: int = 1) -> None:
    """Replace the file at ``path`` by ``content`` as JSON; numbers that JSON lacks become null."""
    write_text(path, json.dumps(finite(content), indent=indent, allow_nan=False) + "\n")


def finite(value: Any) -> Any:
    """``value`` with mappings as dicts, sequences as lists, and None for numbers that JSON lacks.

    >>> finite({"a": (1.0, float("nan"))})
    {'a': [1.0, None]}
    """
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
