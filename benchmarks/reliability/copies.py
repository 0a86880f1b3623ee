"""Commands in copies of a process that has imported and run them once, and in processes of their own."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path


class Started:
    """A command that runs in a process of its own.

    A copy of this process need not import anything, so a kill hits the work and not the imports. The copy is still a
    process of its own, with its own signals, descriptors and memory.

    Args:
        words: the command and its keys.
        fresh: whether to start another interpreter in place of a copy.
    """

    def __init__(self, words: Sequence[str], fresh: bool = False) -> None:
        self.words = list(words)
        self._told = tempfile.TemporaryFile()  # noqa: SIM115 (ends with this object)
        self.status: int | None = None
        self.pid = self._popen() if fresh else self._fork()

    def _popen(self) -> int:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        return subprocess.Popen(
            [sys.executable, "-m", "agents.cli", *self.words],
            stdout=subprocess.DEVNULL, stderr=self._told, env=environment, start_new_session=True,
        ).pid  # fmt: skip

    def _fork(self) -> int:
        sys.stdout.flush()
        sys.stderr.flush()
        gc.freeze()  # so that the copy leaves memory pages of existing objects alone
        pid = os.fork()
        if pid:
            return pid
        status = 70
        try:
            os.setsid()
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(self._told.fileno(), 2)
            sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False, errors="replace") for number in (1, 2))
            from agents.cli import main

            status = main(self.words)
        except BaseException as error:  # no exception may come through
            os.write(2, f"Traceback: {type(error).__name__}: {error}".encode(errors="replace"))
        finally:
            with contextlib.suppress(BaseException):
                sys.stderr.flush()
            os._exit(status)

    def wait(self, seconds: float | None = None) -> int | None:
        """The exit status, minus the signal that ended it; None while it runs longer than ``seconds``."""
        limit = None if seconds is None else time.monotonic() + seconds
        while self.status is None:
            found, status = os.waitpid(self.pid, 0 if limit is None else os.WNOHANG)
            if found:
                self.status = os.waitstatus_to_exitcode(status)
            elif limit is not None and time.monotonic() >= limit:
                return None
            else:
                time.sleep(0.002)
        return self.status

    def send(self, number: signal.Signals) -> None:
        """A signal to the process alone, not to the processes it started."""
        if self.status is None:
            os.kill(self.pid, number)

    def end(self) -> None:
        """SIGKILL, and wait."""
        self.send(signal.SIGKILL)
        self.wait()

    def orphans(self, seconds: float = 10.0) -> list[int]:
        """Processes it started that live on ``seconds`` after its end; they are ended."""
        limit = time.monotonic() + seconds
        while (found := _of_session(self.pid)) and time.monotonic() < limit:
            time.sleep(0.05)
        for pid in found:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return found

    @property
    def told(self) -> str:
        """What it wrote on stderr."""
        self._told.seek(0)
        return self._told.read().decode(errors="replace")


def complete(words: Sequence[str], fresh: bool = False, seconds: float | None = None) -> Started:
    """A command that has ended."""
    started = Started(words, fresh)
    if started.wait(seconds) is None:
        started.end()
    return started


def _of_session(session: int) -> list[int]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError, ValueError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(int(folder.name))
    return found
