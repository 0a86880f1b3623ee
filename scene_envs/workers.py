"""Worker processes, and actors of a Ray cluster, that answer tasks one at a time.

A worker imports a target, ``"module:name"``, and calls it with the body of each task. A target with arguments is called
once with them, and its result answers. If an answer is a generator, what it yields is sent as reports, and what it
returns is the answer. A worker ends when its task takes too long, when its pool closes, and when the parent is gone.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import time
import traceback
import weakref
from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import spawn
from multiprocessing.connection import Connection, wait
from types import MappingProxyType
from typing import Any

from scene_envs.errors import InvalidInputError, MissingDependencyError, PhysicsError, SceneEnvsError

_LOGGER = logging.getLogger(__name__)
START_UP = 120.0
"""Seconds that a worker may take to start, or to take in what a task needs once."""
_MAX_FAILED_STARTS = 3
_GRACE = 2.0
"""Seconds that a process whose pipe was closed has to end by itself, so that its own exit status is known."""
_ALARM = 5.0
"""Seconds after its deadline at which a process ends itself, if its parent has not ended it."""
_MAX_TEXT = 2000
"""Largest number of characters of an error message from a worker."""
_DISTURBED = (
    "disturbed the answers of its process, which was ended; its code may write to and close no file descriptor that it "
    "did not open"
)
_CODE = (
    "import sys; sys.path[:] = filter(None, sys.path); "  # without the current folder, the first place of imports
    "from scene_envs.workers import serve; serve(*map(int, sys.argv[1:]))"
)
_ERRORS = vars(sys.modules[SceneEnvsError.__module__])
_is_importing_main = False


class WorkerFailure(Exception):
    """Reason why a task has no result, as the predicate of a sentence about the task; late after its deadline."""

    def __init__(self, text: str, is_late: bool = False) -> None:
        super().__init__(text)
        self.is_late = is_late


@dataclass(frozen=True)
class Task:
    """One task of a pool."""

    body: Any  # argument of the target, picklable
    name: str  # subject of messages about the task
    once: tuple[Hashable, Callable[[], Any]] | None = None  # key and maker of what each worker must answer once, before
    split: Callable[[], Sequence[Task]] | None = None  # makes smaller tasks to try after a failure; None tries again


class _Target:
    """A target in its worker; ``here`` is the process of the pool itself, where exits and interrupts are raised."""

    def __init__(self, here: bool = False, paths: Sequence[str] = ()) -> None:
        sys.path.extend(path for path in paths if path not in sys.path)  # for machines that share a disk
        self._here = here
        self._answer: Callable[[Any], Any] | None = None

    def process_id(self) -> int:
        return os.getpid()

    def messages(self, body: Any) -> Iterator[tuple[str, Any]]:
        """Kinds and contents of the messages that answer a task, the first of which says what the target is."""
        try:
            answer = self._start(*body) if self._answer is None else self._answer(body)
            while isinstance(answer, Generator):
                try:
                    yield "report", next(answer)
                except StopIteration as end:
                    answer = end.value
            last: tuple[str, Any] = ("done", answer)
        except SceneEnvsError as error:  # by names and text, since not every error can be pickled
            names = [base.__name__ for base in type(error).__mro__]
            last = ("refused", error if self._here else (names, str(error)[:_MAX_TEXT]))
        except BaseException as error:
            if self._here and not isinstance(error, Exception):
                raise
            last = ("failed", (f"failed ({type(error).__name__}: {error})"[:_MAX_TEXT], traceback.format_exc()))
        yield last

    def _start(self, name: str, arguments: Sequence[Any] | None, memory: int | None) -> Any:
        module, _, attribute = name.partition(":")
        made = getattr(import_module(module), attribute)
        if memory is not None:
            _limit_memory(memory)
        self._answer = made if arguments is None else made(*arguments)
        return None


def serve(read: int, write: int) -> None:
    """Answer the tasks that come from one pipe on the other, until the first closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    threading.Thread(target=_end_with_parent, args=(read,), daemon=True).start()
    inbox, outbox = Connection(read, writable=False), Connection(write, readable=False)
    target, process = _Target(), os.getpid()
    while True:
        try:
            number, timeout, body = inbox.recv()
        except EOFError:
            return
        except OSError:  # the target closed the pipe
            os._exit(1)
        if timeout is not None:  # the default action of the signal ends even code that holds the GIL
            signal.setitimer(signal.ITIMER_REAL, timeout + _ALARM)
        for kind, part in target.messages(body):
            if os.getpid() != process:  # a copy that the target forked came back here: it must not answer
                os._exit(0)
            if kind != "report":
                signal.setitimer(signal.ITIMER_REAL, 0)
            try:
                outbox.send((number, kind, part))
            except OSError:
                os._exit(1)


def _end_with_parent(inbox: int) -> None:
    """End this process, and those that it started, when the other end of the pipe closes."""
    poll = select.poll()
    poll.register(inbox, 0)  # hang-ups alone
    poll.poll()
    os.killpg(os.getpgid(0), signal.SIGKILL)


def _limit_memory(memory: int) -> None:
    """Allow ``memory`` bytes beyond what this process has now (on Linux), and write no core files."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with open("/proc/self/status") as file:
            now = next(int(line.split()[1]) for line in file if line.startswith("VmData")) * 1024
        resource.setrlimit(resource.RLIMIT_DATA, (now + memory, now + memory))


def main_module() -> dict[str, Any]:
    """What :func:`import_main` in a worker needs to know about the main module of this process."""
    facts = spawn.get_preparation_data("")
    return {key: value for key, value in facts.items() if key.startswith("init_main") or key == "sys_argv"}


def import_main(main: Mapping[str, Any]) -> None:
    """Import the main module of the parent, so that what it defines can be unpickled; it may start no workers."""
    global _is_importing_main
    _is_importing_main = True
    try:
        spawn.prepare(dict(main))
    finally:
        _is_importing_main = False


class _Worker:
    """One worker as its parent sees it; subclasses send to it, receive from it and end it."""

    source: Any  # ready for reading when the worker has answered or ended

    def __init__(self) -> None:
        self.is_alive, self.is_ready = True, False  # ready: it has started, and has taken in what it was sent once
        self.known: set[Hashable] = set()  # keys of what it was sent once
        self.task: Any = None  # what the pool keeps about the task that it works on
        self._is_late = False
        self._timeout: float | None = None
        self._clock: threading.Timer | None = None

    def send(self, body: Any, timeout: float | None) -> None:
        """Give the worker a task, and end it if that takes longer than ``timeout`` seconds."""
        self._timeout = timeout
        self.start_clock()

    def receive(self) -> tuple[str, Any]:
        """Kind and content of the next message; a failure if the worker is lost."""
        raise NotImplementedError

    def answer(self) -> Any:
        """The answer to what was sent last, or to the start. Raises WorkerFailure where there is none (a lost worker is
        not alive afterwards), and the target's SceneEnvsError.
        """
        kind = "report"
        try:
            while kind == "report":
                kind, answer = self.receive()
        except BaseException:
            self.stop()
            raise
        if kind == "done":
            return answer
        raise answer

    def stop(self) -> None:
        """End the worker at once."""
        self.is_alive = False
        self.stop_clock()

    def kill(self) -> None:
        """End the worker from any thread; :meth:`receive` notices."""

    def _end_late(self) -> None:
        self._is_late = True
        self.kill()

    def start_clock(self) -> None:
        """End the worker when its time is over."""
        if self._timeout is not None:
            self._clock = threading.Timer(self._timeout, self._end_late)
            self._clock.daemon = True
            self._clock.start()

    def stop_clock(self) -> None:
        if self._clock is not None:
            self._clock.cancel()

    def _taken(self, kind: str, body: Any) -> tuple[str, Any]:
        if kind == "report":
            return kind, body
        self.stop_clock()
        if self._is_late:  # it answered at the last moment, and was ended all the same
            self.stop()
        if kind == "failed":
            text, trace = body
            body = WorkerFailure(text)
            body.__cause__ = RuntimeError(f"\n{trace}")
        elif kind == "refused" and not isinstance(body, SceneEnvsError):
            names, text = body
            body = next(_ERRORS[name] for name in names if name in _ERRORS)(text)
        return kind, body

    def _lost(self, how: str, is_late: bool = False) -> tuple[str, WorkerFailure]:
        late = self._is_late or is_late
        self.stop()
        return "failed", WorkerFailure(f"took longer than {self._timeout:g} s" if late else how, late)


class Process(_Worker):
    """A worker process, and the two pipes to it.

    ``target`` is ``"module:name"`` of what answers, or of its maker with the ``arguments`` (None: the target itself
    answers). ``memory`` is the bytes that it may allocate beyond what the import of the target needs (on Linux);
    ``environment`` are added variables. ``stdout`` and ``stderr`` are descriptors, None for this process's stderr;
    ``start_up`` is the seconds that the start may take, None for no limit.
    """

    def __init__(
        self,
        target: str,
        arguments: Sequence[Any] | None = (),
        *,
        memory: int | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
        stdout: int = subprocess.DEVNULL,
        stderr: int | None = None,
        start_up: float | None = START_UP,
    ) -> None:
        super().__init__()
        if _is_importing_main:
            raise InvalidInputError("a script must start workers under `if __name__ == '__main__':`")
        child_reads, parent_writes = os.pipe()
        parent_reads, child_writes = os.pipe()
        places = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-c", _CODE, str(child_reads), str(child_writes)],
                pass_fds=(child_reads, child_writes),
                env={**os.environ, "PYTHONPATH": places, **environment},
                stdin=subprocess.DEVNULL,
                stdout=stdout,
                stderr=stderr,
                start_new_session=True,  # so that what it starts is ended with it
            )
        finally:
            os.close(child_reads)
            os.close(child_writes)
        self.process_id = self.process.pid
        self._outbox, self.source = Connection(parent_writes, readable=False), Connection(parent_reads, writable=False)
        self._end = weakref.finalize(self, _end, self.process, self._outbox, self.source)
        self._number = 0
        self.send((target, arguments, memory), start_up)

    def send(self, body: Any, timeout: float | None) -> None:
        self._number += 1
        message = pickle.dumps((self._number, timeout, body))
        super().send(body, timeout)
        try:
            self._outbox.send_bytes(message)
        except OSError:
            pass  # the process ended, which receive() notices
        except BaseException:
            self.stop()
            raise

    def receive(self) -> tuple[str, Any]:
        try:
            number, kind, body = self.source.recv()
            if number != self._number or kind not in ("report", "done", "refused", "failed"):
                return self._lost(_DISTURBED)
        except (EOFError, OSError):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(_GRACE)  # before the pipes are closed, which makes the process end itself
            status = self.process.returncode
            if status is None:
                return self._lost(_DISTURBED)
            how = f"ended its process (exit status {status}) without an answer"
            if status < 0:
                with contextlib.suppress(ValueError):
                    how = f"crashed its process ({signal.Signals(-status).name})"
            return self._lost(how, status == -signal.SIGALRM)
        except Exception:
            return self._lost(_DISTURBED)
        return self._taken(kind, body)

    def kill(self) -> None:
        _kill(self.process)

    def stop(self) -> None:
        super().stop()
        self._end()


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


def run_apart(target: str, body: Any, timeout: float | None) -> Any:
    """The answer of a target to one task, from a process of its own that may take ``timeout`` seconds in all. Raises as
    :meth:`Process.answer`.
    """
    end = None if timeout is None else time.monotonic() + timeout
    worker = Process(target, None, stderr=subprocess.DEVNULL, start_up=timeout)
    try:
        worker.answer()
        worker.send(body, None if end is None else max(0.0, end - time.monotonic()))
        return worker.answer()
    finally:
        worker.stop()


class _Here(_Worker):
    """This process in place of a worker, without deadlines."""

    def __init__(self, target: str, arguments: Sequence[Any] | None) -> None:
        super().__init__()
        self._target = _Target(here=True)
        self.send((target, arguments, None), None)

    def send(self, body: Any, timeout: float | None) -> None:
        self.source = self._target.messages(body)

    def receive(self) -> tuple[str, Any]:
        return self._taken(*next(self.source))


class _Actor(_Worker):
    """An actor of Ray, and the stream of its messages."""

    def __init__(self, ray: Any, target: str, arguments: Sequence[Any] | None) -> None:
        super().__init__()
        self._ray = ray
        # no CPU is reserved: a pool that has nothing to do must not keep another pool from starting workers
        options = {"num_cpus": 0, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        self._actor = ray.remote(_Target).options(**options).remote(False, [path or os.getcwd() for path in sys.path])
        self.send((target, arguments, None), START_UP)

    @property
    def process_id(self) -> int:
        return int(self._ray.get(self._actor.process_id.remote()))

    def send(self, body: Any, timeout: float | None) -> None:
        self.source = self._actor.messages.options(num_returns="streaming").remote(body)
        super().send(body, timeout)

    def receive(self) -> tuple[str, Any]:
        try:
            kind, body = self._ray.get(next(self.source))
        except self._ray.exceptions.RayError as error:
            return self._lost(f"lost its actor ({type(error).__name__})")
        if isinstance(body, dict):  # arrays of the object store are read-only
            body = {name: part.copy() if hasattr(part, "flags") else part for name, part in body.items()}
        return self._taken(kind, body)

    def kill(self) -> None:
        with contextlib.suppress(Exception):
            self._ray.kill(self._actor)

    def stop(self) -> None:
        super().stop()
        self.kill()


def require_ray() -> Any:
    """The module ray; raises MissingDependencyError."""
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError("workers on a Ray cluster need Ray: pip install 'scene-envs[ray]'") from error
    return ray


_ray_users = 0
"""Number of pools of this process that use the connection to Ray; one of these pools made it."""


class WorkerPool:
    """Workers that answer tasks; the results do not depend on their number.

    A task that raises, ends its worker or takes more than ``timeout`` seconds (None: no limit) is tried once more. Lost
    workers are replaced. ``target``, ``arguments`` and ``options`` are as for :class:`Process`. Of ``workers``
    processes, 0 computes in this process. With ``ray``, workers are actors of a Ray cluster, as many as it has CPUs:
    the cluster that this process is connected to, or else the one at ``address`` or ``RAY_ADDRESS``, or else one with
    ``workers`` CPUs (None: all) on this machine, which ends with the last pool. Raises InvalidInputError for a number
    out of range or no cluster at the address, and MissingDependencyError without Ray.
    """

    def __init__(
        self,
        target: str,
        arguments: Sequence[Any] | None = (),
        *,
        workers: int | None,
        timeout: float | None = None,
        ray: bool = False,
        address: str | None = None,
        **options: Any,
    ) -> None:
        self._closed, self._has_connection = True, False
        self._live: list[Any] = []
        self._ray: Any = None
        self._lock = threading.Lock()
        self._failed_starts = 0
        if workers is not None and workers < 0:
            raise InvalidInputError(f"workers must be 0 or more, got {workers}; 0 computes in this process")
        if timeout is not None and not timeout > 0:
            raise InvalidInputError(f"timeout must be a positive number of seconds, got {timeout}")
        if ray:
            workers = self._connect(workers, address)
        self.workers, self.timeout = workers or 0, timeout
        self._make: Callable[[], Any] = (
            (lambda: _Actor(self._ray, target, arguments))
            if ray
            else (lambda: Process(target, arguments, **options) if workers else _Here(target, arguments))
        )
        self._closed = False

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()

    def close(self) -> None:
        """End all workers; the pool cannot be used afterwards."""
        global _ray_users
        self._closed = True
        while self._live:
            self._live.pop().stop()
        if self._has_connection:
            self._has_connection = False
            _ray_users -= 1
            if not _ray_users:
                self._ray.shutdown()

    @property
    def process_ids(self) -> list[int]:
        """Operating-system ids of the running workers."""
        return [worker.process_id for worker in self._live if self.workers]

    def map(
        self,
        tasks: Sequence[Task],
        *,
        done: Callable[[Task, Any], None] | None = None,
        report: Callable[..., None] | None = None,
    ) -> list[Any]:
        """The results of all tasks in order, a :class:`WorkerFailure` where a task failed twice, and the results of its
        parts in place of a task that was split. ``done`` is called with each task and its result at once, ``report``
        with workers' reports. Raises the target's SceneEnvsError, other tasks being given up, and PhysicsError where
        workers do not start or the pool was closed.
        """
        if self._closed:
            raise PhysicsError(f"this {type(self).__name__} was closed; make a new one")
        results: dict[tuple[int, ...], Any] = {}
        queue = deque(((place,), task, False) for place, task in enumerate(tasks))
        with self._lock:
            try:
                self._discard(lambda one: isinstance(one, Process) and one.process.poll() is not None)  # between calls
                for worker in self._live:  # those that were starting at the end of the last call
                    if not worker.is_ready:
                        worker.start_clock()
                while queue or any(worker.task for worker in self._live):
                    self._give(queue)
                    for worker in self._answering():
                        self._take(worker, queue, results, done, report)
            except BaseException:
                self._discard(lambda one: one.task is not None or not one.is_ready)
                raise
            for worker in self._live:
                worker.stop_clock()
        return [results[place] for place in sorted(results)]

    def _answering(self) -> list[Any]:
        """The workers that have answered or ended, as soon as there are some."""
        waiting = [worker for worker in self._live if worker.task is not None or not worker.is_ready]
        if not waiting or not self.workers:
            return waiting
        sources = [worker.source for worker in waiting]
        ready = wait(sources) if self._ray is None else self._ray.wait(sources, num_returns=1)[0]
        return [worker for worker in waiting if worker.source in ready]

    def _give(self, queue: deque[Any]) -> None:
        """Start the workers that there is work for, and give idle ones what they lack or their next task."""
        busy = sum(worker.task is not None for worker in self._live)
        while len(self._live) < min(self.workers or 1, len(queue) + busy):
            self._live.append(self._make())
        for worker in self._live:
            if not worker.is_ready or worker.task is not None or not queue:
                continue
            once = queue[0][1].once
            if once is not None and once[0] not in worker.known:
                worker.known.add(once[0])
                worker.is_ready = False
                worker.send(once[1](), START_UP)
            else:
                worker.task = queue.popleft()
                worker.send(worker.task[1].body, self.timeout)

    def _take(self, worker: Any, queue: deque[Any], results: dict[Any, Any], done: Any, report: Any) -> None:
        kind, body = worker.receive()
        if kind == "report":
            if report is not None:
                report(*body)
            return
        entry, worker.task = worker.task, None
        if kind == "refused":
            raise body
        if entry is None:
            worker.is_ready = kind == "done"
            self._failed_starts = 0 if worker.is_ready else self._failed_starts + 1
            if self._failed_starts >= _MAX_FAILED_STARTS:
                raise PhysicsError(f"the start of {_MAX_FAILED_STARTS} workers in a row {body}; stderr may say more")
        self._discard(lambda one: one is worker and not (one.is_alive and one.is_ready))
        if entry is None:
            return
        place, task, is_retry = entry
        if kind == "failed" and not is_retry:
            _LOGGER.warning("%s %s; it is tried once more", task.name, body)
            parts = [(place, task)] if task.split is None else [((*place, k), p) for k, p in enumerate(task.split())]
            queue.extendleft((part_place, part, True) for part_place, part in reversed(parts))
            return
        results[place] = body
        if done is not None:
            done(task, body)

    def _discard(self, chosen: Callable[[Any], bool]) -> None:
        """End the chosen workers."""
        for worker in [worker for worker in self._live if chosen(worker)]:
            self._live.remove(worker)
            worker.stop()

    def _connect(self, cpus: int | None, address: str | None) -> int:
        """Connect to Ray, if nothing has; returns the CPUs of the cluster."""
        global _ray_users
        self._ray = require_ray()
        is_ours = bool(_ray_users) or not self._ray.is_initialized()  # or other code made the connection
        if is_ours and not _ray_users:
            options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
            address = address or os.environ.get("RAY_ADDRESS") or None
            if not address:
                options |= {"num_cpus": cpus, "include_dashboard": False}
            try:
                self._ray.init(address=address, **options)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InvalidInputError(f"cannot connect to a Ray cluster at address={address!r}: {error}") from error
        self._has_connection = is_ours
        _ray_users += is_ours
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))
