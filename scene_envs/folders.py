"""Locks of folders, which admit one writer at a time, and removal of half-written files of killed writers."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene_envs.errors import InvalidInputError, StorageError
from scene_envs.files import storage_error

LOCK = ".writer.lock"
_BEAT, _SILENCE = 15, 60
"""Seconds between two signs of life of a writer, and seconds without a sign of life after which a writer on another
computer counts as ended."""
_PARTIAL = re.compile(r"\..*?\.(?P<process>\d+)(\.\w+)?\.partial")
_held: set[Path] = set()
_guard = threading.Lock()


@contextmanager
def claimed(folder: str | os.PathLike[str], owner: str) -> Iterator[Path]:
    """Context in which this process alone writes into ``folder``, which is made if it is missing.

    The claim ends with the process, even if it is killed, and may be repeated by the same process. Half-written files
    of killed processes in the folder are removed.

    Args:
        folder: Folder to write into.
        owner: Name of the writer, for the error message of other processes.

    Raises:
        InvalidInputError: another process writes into the folder (it is named), or ``folder`` is a file.
        StorageError: the folder cannot be made or written to.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as parent, claimed(Path(parent) / "run", "a test") as folder:
    ...     [path.name for path in folder.iterdir()]
    ['.writer.lock']
    """
    folder = Path(folder)
    key = Path(os.path.realpath(folder))
    with _guard:
        again = key in _held
        _held.add(key)
    if again:
        yield folder
        return
    lock = -1
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _lock(folder / LOCK, owner)
            sweep(folder)
        except (FileExistsError, NotADirectoryError):
            raise InvalidInputError(f"output={str(folder)!r} is a file, not a folder; give another") from None
        except StorageError:
            raise
        except OSError as error:
            raise storage_error(folder, error) from error
        with _heartbeat(lock):
            yield folder
    finally:
        with _guard:
            _held.discard(key)
        if lock >= 0:
            with contextlib.suppress(OSError):
                (folder / LOCK).unlink(missing_ok=True)
            os.close(lock)


def sweep(folder: Path) -> None:
    """Remove files that ended processes left half-written in ``folder`` and its subfolders."""
    for path in folder.rglob(".*.partial"):
        found = _PARTIAL.fullmatch(path.name)
        if found is None or int(found["process"]) == os.getpid() or not _is_alive(int(found["process"])):
            with contextlib.suppress(OSError):
                path.unlink()


def _lock(path: Path, owner: str) -> int:
    """The descriptor of the locked file; the operating system releases the lock when the process ends."""
    import fcntl

    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            writer = os.pread(descriptor, 500, 0).decode(errors="replace").strip()
            os.close(descriptor)
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise InvalidInputError(
                    f"{str(path.parent)!r} is being written by {writer or 'another process'}; wait until it is done, "
                    f"or give another output{_takeover(writer, path)}"
                ) from None
            raise
        if (foreign := _owner_elsewhere(descriptor)) is not None:
            os.close(descriptor)
            raise InvalidInputError(
                f"{str(path.parent)!r} is being written by {foreign}, whose last sign of life is less than "
                f"{_SILENCE} s old; give another output, or, if that computer was switched off, wait a minute or "
                f"remove {str(path)!r}"
            )
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(descriptor).st_ino == os.stat(path).st_ino:  # it was not removed meanwhile
                text = f"{owner}, process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%F %T')}"
                os.truncate(descriptor, 0)
                os.pwrite(descriptor, text.encode(), 0)
                return descriptor
        os.close(descriptor)


def _takeover(writer: str, path: Path) -> str:
    elsewhere = writer and f" on {socket.gethostname()}, since" not in writer
    return f"; if that computer was switched off, remove {str(path)!r}" if elsewhere else ""


def _owner_elsewhere(descriptor: int) -> str | None:
    """The owner of the lock if it is on another computer and gave a recent sign of life; else None.

    A file system may share files between computers without their locks.
    """
    writer = os.pread(descriptor, 500, 0).decode(errors="replace").strip()
    found = re.search(r"process \d+ on (.+), since", writer)
    recent = time.time() - os.fstat(descriptor).st_mtime < _SILENCE
    return writer if found is not None and found[1] != socket.gethostname() and recent else None


@contextmanager
def _heartbeat(descriptor: int) -> Iterator[None]:
    """Context that sets the lock file's modification time to now every few seconds, as a sign of life."""
    done = threading.Event()

    def beat() -> None:
        while not done.wait(_BEAT):
            with contextlib.suppress(OSError):
                os.utime(descriptor)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
