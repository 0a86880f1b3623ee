"""Several post-training runs at the same time, each in a process of its own."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Generator, Iterable, Mapping

from agents.post_training.config import PostTrainConfig
from agents.post_training.trainer import PostTrainResult, post_train
from agents.priors.prior import ScenePrior
from scene_envs.worker_processes import module_command, module_environment

_GRACE = 30.0
"""Seconds in which a process that is told to end may finish its step and save."""


def post_train_side_by_side(
    configs: Mapping[str, PostTrainConfig], prior: ScenePrior, *, cores: int | None = None
) -> Generator[tuple[str, PostTrainResult]]:
    """Post-train one prior in several ways, with a process and an equal part of the cores for each run.

    One run seldom keeps two cores busy, because its operations are small. Two runs side by side do. A process that ends
    early leaves its run as an interrupted one. This process then resumes it, or raises the error that ended it.

    Args:
        configs: the runs by name; each has an output folder of its own.
        prior: the prior to start from; it is not changed.
        cores: processor cores to use; None for those that this process may run on. With fewer cores than runs, or where
            a run cannot be pickled (its reward is a lambda), the runs follow one another in this process.

    Yields:
        The name and the result of each run as soon as it is finished. Runs that are not finished when the iterator is
        closed save and end.

    Raises:
        SceneEnvsError: as :func:`~agents.post_training.post_train`. The other runs are finished or can be resumed.
    """
    cores = len(os.sched_getaffinity(0)) if cores is None else cores
    runs = _pickled(configs, prior) if 1 < len(configs) <= cores else {}
    if not runs:
        yield from ((name, post_train(config, prior=prior)) for name, config in configs.items())
        return
    with contextlib.closing(_run_processes(runs, cores // len(runs))) as ended:
        for name in ended:
            yield name, post_train(configs[name], prior=prior)


def _pickled(configs: Mapping[str, PostTrainConfig], prior: ScenePrior) -> dict[str, bytes]:
    """What the process of each run reads; nothing where a run cannot be pickled."""
    try:
        return {name: pickle.dumps((config, prior)) for name, config in configs.items()}
    except (pickle.PicklingError, AttributeError, TypeError):
        return {}


def _run_processes(runs: Mapping[str, bytes], threads: int) -> Generator[str]:
    """Start a process for each run, and yield the name of each run whose process ended."""
    environment = module_environment() | {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    processes: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, run in runs.items():
            with tempfile.TemporaryFile() as file:
                file.write(run)
                file.seek(0)
                processes[name] = subprocess.Popen(
                    module_command(__name__),
                    stdin=file,
                    stderr=subprocess.PIPE,
                    env=environment,
                    start_new_session=True,  # Ctrl-C reaches this process alone, which then tells the others
                )
            threading.Thread(target=_pass_on, args=(name, processes[name]), daemon=True).start()
        running = dict(processes)
        while running:
            for name in [name for name, process in running.items() if process.poll() is not None]:
                del running[name]
                yield name
            time.sleep(0.1)
    finally:
        _end(processes.values())


def _pass_on(name: str, process: subprocess.Popen[bytes]) -> None:
    """Print each line that a process writes, with the name of its run."""
    assert process.stderr is not None
    for line in process.stderr:
        sys.stderr.write(f"{name}: {line.decode(errors='replace')}")
        sys.stderr.flush()


def _end(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    """Tell processes that still run to save and end; kill those that do not."""
    running = [process for process in processes if process.poll() is None]
    for process in running:
        process.terminate()
    for process in running:
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()


def _main() -> None:
    """One run, read from standard input."""
    from agents.utils.interrupts import terminable

    config, prior = pickle.load(sys.stdin.buffer)
    try:
        with terminable():
            post_train(config, prior=prior)
    except KeyboardInterrupt:
        sys.exit(1)
    except Exception as error:
        sys.exit(f"stopped: {type(error).__name__}: {error}")


if __name__ == "__main__":
    _main()
