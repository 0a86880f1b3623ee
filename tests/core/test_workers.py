"""Workers: order, deadlines, retries and ends of tasks; modules come from where this process has them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

from scene_envs.errors import InvalidInputError, PhysicsError
from scene_envs.workers import Process, Task, WorkerFailure, WorkerPool, run_apart

TARGET = f"{__name__}:Target"


class Target:
    """Answers of a worker of these tests: ``(word, argument)``."""

    def __init__(self, scale: int) -> None:
        self.scale, self.sent = scale, 0

    def __call__(self, body: tuple[str, Any]) -> Any:
        word, argument = body
        if word == "scaled":
            time.sleep(0.002 * (argument % 3))
            return self.scale * argument
        if word == "once":
            self.sent += argument
        if word == "sent":
            return self.sent
        if word == "steps":
            return self.steps(argument)
        if word == "sum":
            if 5 in argument:
                raise ZeroDivisionError("a five")
            return sum(argument)
        if word == "dies" and not Path(argument).exists():
            Path(argument).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if word == "leaves":
            os._exit(argument)
        if word == "hangs":
            time.sleep(argument)
        if word == "fills":
            return len(bytearray(argument))
        if word == "refuses":
            raise InvalidInputError(argument)
        return os.getpid()

    def steps(self, count: int) -> Generator[tuple[int], None, int]:
        """A report for each step; returns their number."""
        for step in range(count):
            yield (step,)
        return count


def broken(scale: int) -> None:
    raise OSError("no target")


def tasks(word: str, *arguments: Any, **facts: Any) -> list[Task]:
    return [Task((word, argument), f"task {argument}", **facts) for argument in arguments]


@pytest.fixture(scope="module")
def pool() -> Iterator[WorkerPool]:
    with WorkerPool(TARGET, (10,), workers=2, timeout=20.0) as pool:
        yield pool


@pytest.mark.parametrize("workers", [0, 1, 3])
def test_results_come_in_order_for_any_number_of_workers(workers: int) -> None:
    with WorkerPool(TARGET, (10,), workers=workers) as pool:
        assert pool.map(tasks("scaled", *range(20))) == [10 * number for number in range(20)]
        assert len(pool.process_ids) == workers
        once = ("key", lambda: ("once", 7))
        assert pool.map(tasks("sent", *range(6), once=once)) == [7] * 6
        assert pool.map([]) == []
        processes = pool.process_ids
    assert not any(is_running(process) for process in processes)


def test_a_task_that_fails_is_split_and_a_part_that_fails_again_has_a_reason(pool: WorkerPool) -> None:
    here = WorkerPool(TARGET, (10,), workers=0)
    for some in (pool, here):
        whole = Task(("sum", [4, 5, 6]), "numbers 4 to 6", split=lambda: tasks("sum", [4], [5], [6]))
        first, four, five, six, last = some.map([*tasks("sum", [1, 2]), whole, *tasks("sum", [7])])
        assert (first, four, six, last) == (3, 4, 6, 7)
        assert isinstance(five, WorkerFailure)
        assert str(five) == "failed (ZeroDivisionError: a five)"
        assert "test_workers.py" in str(five.__cause__)


def test_a_task_whose_worker_was_killed_is_done_by_another(
    pool: WorkerPool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (result,) = pool.map(tasks("dies", tmp_path / "died"))
    assert result in pool.process_ids
    assert f"task {tmp_path / 'died'} crashed its process (SIGKILL); it is tried once more" in caplog.text


def test_tasks_that_end_their_worker_or_take_too_long_twice_fail_and_say_how(pool: WorkerPool) -> None:
    finished: list[Any] = []
    results = pool.map([*tasks("leaves", 3), *tasks("scaled", 1)], done=lambda task, result: finished.append(result))
    assert str(results[0]) == "ended its process (exit status 3) without an answer"
    assert results[1] == 10
    assert set(finished) == set(results)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pool, "timeout", 0.2)
        (late,) = pool.map(tasks("hangs", 60))
    assert late.is_late
    assert str(late) == "took longer than 0.2 s"
    assert pool.map(tasks("scaled", 2)) == [20]


def test_what_a_target_refuses_is_raised_and_reports_are_passed_on(pool: WorkerPool) -> None:
    with pytest.raises(InvalidInputError, match="not this"):
        pool.map([*tasks("scaled", 1, 2), *tasks("refuses", "not this")])
    reported: list[int] = []
    assert pool.map(tasks("steps", 3), report=reported.append) == [3]
    assert reported == [0, 1, 2]


def test_an_interrupt_ends_the_workers_that_work(pool: WorkerPool) -> None:
    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    pool.map(tasks("scaled", 1, 2))
    before = set(pool.process_ids)
    with pytest.raises(KeyboardInterrupt):
        pool.map([*tasks("steps", 1), *tasks("hangs", 60)], report=interrupt)
    assert not any(is_running(process) for process in before - set(pool.process_ids))
    assert pool.map(tasks("scaled", 1, 2)) == [10, 20]


def test_a_target_that_cannot_be_made_ends_the_call_and_not_the_pool() -> None:
    with WorkerPool(f"{__name__}:broken", (1,), workers=2) as pool:
        with pytest.raises(PhysicsError, match=r"start of 3 workers in a row failed \(OSError: no target\)"):
            pool.map(tasks("scaled", 1))
        assert pool.process_ids == []
    with pytest.raises(PhysicsError, match="this WorkerPool was closed"):
        pool.map([])


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux only")
def test_memory_is_limited_beyond_that_of_the_start() -> None:
    worker = Process(TARGET, (1,), memory=2**28)
    worker.answer()
    worker.send(("fills", 2**20), 20.0)
    assert worker.answer() == 2**20
    worker.send(("fills", 2**29), 20.0)
    with pytest.raises(WorkerFailure, match="MemoryError"):
        worker.answer()
    worker.stop()


def test_one_task_apart() -> None:
    assert run_apart("operator:neg", 3, 60.0) == -3
    with pytest.raises(WorkerFailure, match="took longer than") as caught:
        run_apart("time:sleep", 60.0, 0.5)
    assert caught.value.is_late


def is_running(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(") ")[2][0] not in "ZX"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")
def test_a_worker_ends_with_its_parent_even_while_it_works() -> None:
    code = (
        "from scene_envs.workers import Process\n"
        "worker = Process('time:sleep', None)\n"
        "worker.answer()\n"
        "worker.send(600.0, None)\n"
        "print(worker.process_id, flush=True)\n"
        "worker.answer()\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        assert is_running(worker)
        parent.kill()
    deadline = time.monotonic() + 20.0
    while is_running(worker):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_script_is_imported_for_what_it_defines_and_must_have_a_guard(tmp_path: Path) -> None:
    """As for a grammar whose function stands in the script that generates."""
    (tmp_path / "target.py").write_text(
        "import sys\nfrom scene_envs.workers import import_main\n\n"
        "def mine(main):\n    import_main(main)\n    return sys.modules['__main__'].number\n"
    )
    (tmp_path / "script.py").write_text(
        "import sys\nfrom scene_envs.workers import main_module, run_apart\n\nnumber = 7\n"
        "if __name__ == '__main__' or sys.argv[1] == 'bare':\n"
        "    print(run_apart('target:mine', main_module(), 60.0))\n"
    )

    def run(word: str) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
        command = [sys.executable, str(tmp_path / "script.py"), word]
        return subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    assert run("guarded").stdout == "7\n"
    assert "a script must start workers under `if __name__ == '__main__':`" in run("bare").stderr.splitlines()[-1]
