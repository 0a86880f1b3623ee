"""Process of one reward, seen from the parent process: start, messages, limits, end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import weakref
from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch

from rewards.base import RewardOutput
from scene_envs.errors import InvalidInputError, RewardError, RewardTimeoutError, SceneEnvsError, UnknownNameError
from scene_envs.worker_processes import module_command, module_environment

_START_UP = 120.0
"""Seconds that an empty worker may take to start."""
_GRACE = 2.0
"""Seconds that a worker whose pipe was closed has to end by itself, so that its own exit status is known."""
_MOST_TEXT = 2000
"""Most characters of an error message from the process."""
_ERRORS: dict[str, type[SceneEnvsError]] = {
    kind.__name__: kind for kind in (InvalidInputError, UnknownNameError, RewardError)
}


class RewardProcess:
    """A worker process, the two pipes to it, and the timer that limits its answers.

    Args:
        name: of the reward, for messages.
        timeout: seconds after which the process ends a call by itself.
        memory: GiB that it may allocate beyond what an empty worker needs.

    Raises:
        RewardError: the process did not start.
    """

    def __init__(self, name: str, timeout: float, memory: float) -> None:
        self.name, self.memory = name, memory
        self._asked = 0
        self.alive = True
        child_reads, parent_writes = os.pipe()
        parent_reads, child_writes = os.pipe()
        limits = [str(timeout), str(int(memory * 2**30)), str(torch.get_num_threads())]
        try:
            self.process = subprocess.Popen(
                module_command("rewards.worker", str(child_reads), str(child_writes), *limits),
                pass_fds=(child_reads, child_writes),
                env=module_environment() | {"PYTHONHASHSEED": "0"},
                stdin=subprocess.DEVNULL,
                stdout=2,  # what a reward prints goes to stderr
                start_new_session=True,
            )
        finally:
            os.close(child_reads)
            os.close(child_writes)
        self.outbox = Connection(parent_writes, readable=False)
        self.inbox = Connection(parent_reads, writable=False)
        self._end = weakref.finalize(self, _end, self.process, self.outbox, self.inbox)
        self._receive(None, _START_UP)

    def ask(self, message: tuple[Any, ...], timeout: float) -> Any:
        """The answer to a message; a worker that gives none within ``timeout`` seconds is ended."""
        self._asked += 1
        return self._receive((self._asked, *message), timeout)

    def stop(self) -> None:
        """End the process and all that it started, and close the pipes."""
        self.alive = False
        self._end()

    def _receive(self, message: tuple[Any, ...] | None, timeout: float) -> Any:
        late = threading.Event()

        def end() -> None:  # a process that hangs neither reads nor writes: only its end unblocks recv()
            late.set()
            _kill(self.process)

        clock = threading.Timer(timeout, end)
        clock.daemon = True
        clock.start()
        try:
            if message is not None:
                self.outbox.send(message)
            number, kind, body = self.inbox.recv()
            if number != self._asked or kind not in ("done", "failed"):
                raise ValueError(number)
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_GRACE)  # before stop() closes the pipes, which makes the worker end itself
            ended = self.process.returncode is not None
            self.stop()
            raise self._ended(late.is_set(), timeout) if ended else self._disturbed() from None
        except Exception:
            self.stop()
            raise self._disturbed() from None
        except BaseException:
            self.stop()
            raise
        finally:
            clock.cancel()
        if kind == "done":
            return body
        error, text = body
        raise _ERRORS.get(error, RewardError)(str(text)[:_MOST_TEXT])

    def _disturbed(self) -> RewardError:
        return RewardError(
            f"reward {self.name!r} disturbed the answers of its process, which was ended; a reward may write to and "
            "close no file descriptor that it did not open"
        )

    def _ended(self, late: bool, timeout: float) -> RewardError:
        """The error that describes how the process ended."""
        status, reward = self.process.returncode, f"reward {self.name!r}"
        if late or status == -signal.SIGALRM:
            return RewardTimeoutError(f"{reward} took longer than reward_timeout={timeout:g} s; its process was ended")
        if status is not None and status < 0:
            with contextlib.suppress(ValueError):
                return RewardError(f"{reward} crashed its process ({signal.Signals(-status).name})")
        return RewardError(f"{reward} ended its process (exit status {status}) instead of returning scores")


def _end(process: subprocess.Popen[bytes], outbox: Connection, inbox: Connection) -> None:
    for pipe in (outbox, inbox):
        with contextlib.suppress(OSError):
            pipe.close()
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(0.2)  # a process that is ending by itself keeps its exit status
    _kill(process)
    process.wait()


def _kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)


def packed(output: RewardOutput) -> dict[str, Any]:
    """An output as arrays, to be sent."""
    return {
        "value": output.value.cpu().numpy(),
        "per_object": None if output.per_object is None else output.per_object.cpu().numpy(),
        "terms": {name: term.cpu().numpy() for name, term in output.terms.items()},
        "valid": output.is_valid.cpu().numpy(),
        "object_flags": {name: flag.cpu().numpy() for name, flag in output.object_flags.items()},
    }


def unpacked(body: Mapping[str, Any], device: torch.device) -> RewardOutput:
    """Inverse of :func:`packed`, on a torch device."""

    def tensor(array: Any) -> torch.Tensor:
        return torch.from_numpy(np.array(array)).to(device)

    return RewardOutput(
        tensor(body["value"]),
        None if body["per_object"] is None else tensor(body["per_object"]),
        {name: tensor(term) for name, term in body["terms"].items()},
        tensor(body["valid"]),
        {name: tensor(flag) for name, flag in body["object_flags"].items()},
    )
