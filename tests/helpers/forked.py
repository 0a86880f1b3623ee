"""Processes that begin as copies of the process of the test, with all that it has imported."""

from __future__ import annotations

import contextlib
import faulthandler
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing.context import ForkProcess
from types import ModuleType, SimpleNamespace
from typing import Any, TextIO

import pytest

from scene_envs import workers


def forked(function: Callable[..., Any], *args: Any) -> ForkProcess:
    """Run ``function(*args)`` in a copy of this process, with nothing of its threads; join or kill it."""
    process = multiprocessing.get_context("fork").Process(target=function, args=args, daemon=True)
    process.start()
    return process


def _stream(descriptor: int) -> TextIO:
    return open(descriptor, "w", buffering=1, closefd=False)


class ForkedModule:
    """``subprocess.Popen`` of ``python -m MODULE ...``, or of a worker process, as a copy of this process.

    It has its own descriptors, session, signals, limits and memory. Its interpreter is not new: what this process
    registered is known there, so a test that asks what a new one finds starts a real one.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        pass_fds: Sequence[int] = (),
        env: Mapping[str, str],
        start_new_session: bool = False,
        stdout: int = subprocess.DEVNULL,
        stderr: int | None = None,
        **_: Any,
    ) -> None:
        self.returncode: int | None = None
        self.stdout: TextIO | None = None
        if stdout == subprocess.PIPE:
            read, stdout = os.pipe()
            self.stdout = os.fdopen(read)
        option = command[1]
        assert option in ("-c", "-m")
        self._module, *self._words = command[2:] if option == "-m" else ("", *command[3:])
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                self._run(pass_fds, env, start_new_session, stdout, stderr == subprocess.STDOUT)
            except SystemExit as end:
                os._exit(end.code if isinstance(end.code, int) else 0 if end.code is None else 1)
            except BaseException:
                os._exit(1)
            os._exit(0)
        if self.stdout is not None:
            os.close(stdout)

    def _run(self, kept: Sequence[int], env: Mapping[str, str], new_session: bool, stdout: int, joined: bool) -> None:
        faulthandler.disable()
        if new_session:
            os.setsid()
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 0)
        os.dup2(nothing if stdout == subprocess.DEVNULL else stdout, 1)
        if joined:
            os.dup2(1, 2)
        sys.stdout, sys.stderr = map(_stream, (1, 2))  # pytest's write elsewhere
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            if descriptor > 2 and descriptor not in kept:
                with contextlib.suppress(OSError):  # that of the listing is closed already
                    os.close(descriptor)
        os.environ.update(env)
        sys.argv = [self._module, *self._words]
        if not self._module:
            workers.serve(*map(int, self._words))
            return
        sys.modules.pop(self._module, None)
        runpy.run_module(self._module, run_name="__main__")

    def poll(self) -> int | None:
        """The exit status, minus the signal that ended it; None while it runs."""
        if self.returncode is None:
            found, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if found else None
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end; raises ``subprocess.TimeoutExpired``."""
        limit = float("inf") if timeout is None else time.monotonic() + timeout
        while (status := self.poll()) is None:
            if time.monotonic() >= limit:
                raise subprocess.TimeoutExpired(self._module, timeout or 0.0)
            time.sleep(0.002)
        return status

    def kill(self) -> None:
        """SIGKILL."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def terminate(self) -> None:
        """SIGTERM."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGTERM)


@contextlib.contextmanager
def forked_workers(module: ModuleType = workers) -> Iterator[None]:
    """Processes that a module starts meanwhile, workers by default, are copies of this process."""
    stand_in = SimpleNamespace(**{**vars(subprocess), "Popen": ForkedModule})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "subprocess", stand_in)
        yield
