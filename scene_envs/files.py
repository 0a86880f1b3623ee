"""Atomic file writes with errors that name the file, and JSON without non-finite numbers."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from scene_envs.errors import CorruptFileError, StorageError

DIGEST = "sha256"
"""Key of a JSON file that holds the digest of all other keys and their values."""
_SEAL = "# scene-envs, sha256 of the lines below: "


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context with a temporary file to write, which is renamed to ``path`` when the block ends without an error.

    The folder is made if it is missing. The temporary file lies in the same folder under the hidden name
    ``.<name>.<process>.<random>.partial``. When the block fails, the temporary file is removed, and a file that was at
    ``path`` before stays unchanged.

    Raises:
        StorageError: the operating system refused to write or to rename; the message names the file and the remedy.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / "new" / "a.txt") as partial:
    ...         _ = partial.write_text("all of it")
    ...     [path.name for path in (Path(folder) / "new").iterdir()]
    ['a.txt']
    """
    path = Path(path)
    partial = path.with_name(f".{path.name[:200]}.{os.getpid()}.{secrets.token_hex(4)}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except StorageError:
        raise
    except OSError as error:
        raise storage_error(path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def sealed(text: str) -> str:
    """YAML text after a first line that is a comment with the digest of the text.

    >>> sealed("seed: 0\\n").splitlines()[1:]
    ['seed: 0']
    """
    return f"{_SEAL}{hashlib.sha256(text.encode()).hexdigest()}\n{text}"


def read_sealed(path: str | os.PathLike[str]) -> str:
    """The text that was given to :func:`sealed` before it was written to the file at ``path``.

    Files of earlier versions have no digest; their text is returned as it is.

    Raises:
        CorruptFileError: the file was changed after it was written, or is not UTF-8 text.
        OSError: the file cannot be read.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise CorruptFileError(f"{str(path)!r} is damaged: byte {error.start} is no text") from error
    head, _, rest = text.partition("\n")
    if _SEAL.startswith(head[: len(_SEAL)]) and head and head != f"{_SEAL}{hashlib.sha256(rest.encode()).hexdigest()}":
        raise CorruptFileError(f"{str(path)!r} was cut off or changed after it was written (checksum)")
    return rest if head.startswith(_SEAL) else text


def is_file(path: Path) -> bool:
    """Whether ``path`` is a file; False also for names that the operating system does not allow."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """Whether ``path`` exists; False also for names that the operating system does not allow."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def storage_error(path: str | os.PathLike[str], error: OSError) -> StorageError:
    """The error to raise when ``path`` could not be written."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    refused = error.errno in (errno.EACCES, errno.EPERM, errno.EROFS)
    reason = "the disk is full" if full else error.strerror or str(error)
    remedy = "make the folder writable, or give another output," if refused else "put that right"
    remedy = "make room" if full else remedy
    return StorageError(
        f"cannot write {str(path)!r}: {reason}; finished files are kept; {remedy} and run again to resume"
    )


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Replace the file at ``path`` by ``text`` in UTF-8; errors as for :func:`replacing`."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], content: Any, *, indent: int | None = 1) -> None:
    """Replace the file at ``path`` by ``content`` as JSON; numbers that JSON lacks become null."""
    write_text(path, json.dumps(finite(content), indent=indent, allow_nan=False) + "\n")


def with_digest(content: Mapping[str, Any]) -> dict[str, Any]:
    """``content`` as plain JSON values, with the digest of all of them under the last key, ``sha256``."""
    plain = {key: value for key, value in finite(content).items() if key != DIGEST}
    return {**plain, DIGEST: _digest_of(plain)}


def without_digest(content: Mapping[str, Any], path: str | os.PathLike[str]) -> dict[str, Any]:
    """``content`` without the digest of :func:`with_digest`, after a check against that digest.

    Content without a digest is returned unchanged, because such a file may be written by hand.

    Raises:
        CorruptFileError: the content was changed; the message says how to accept an edit.
    """
    plain = {key: value for key, value in content.items() if key != DIGEST}
    if DIGEST in content and content[DIGEST] != _digest_of(plain):
        raise CorruptFileError(
            f"{str(path)!r} was changed after it was written (checksum); copy it again, or if you edited it, remove "
            f"its key {DIGEST!r} to read it without a check"
        )
    return plain


def _digest_of(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


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
