"""Launchers of several processes: Accelerate's beside torchrun, and the variables of MPI."""

from __future__ import annotations

import os
import runpy
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.distributed.elastic.multiprocessing.subprocess_handler import subprocess_handler

from agents.cli.main import main
from agents.post_training.run_files import CHECKPOINT_NAME
from agents.priors.testing import tiny_prior
from agents.utils.process_group import ProcessGroup, is_first_process, launched_processes
from scene_envs.errors import InvalidInputError
from tests.helpers.forked import ForkedModule
from tests.helpers.processes import in_processes

KEYS = (
    "post-train reward=object_count iterations=1 batch_size=4 num_steps=4 "
    "algorithm.gradient_steps=2 regularisation.bank_size=20 regularisation.batch_size=4 guard.scenes=8 guard.samples=0 "
    "progress=none logger.report_scenes=0 device=cpu"
)
LAUNCHER = (
    "accelerate.commands.launch --multi_gpu --num_processes 2 --num_machines 1 --mixed_precision no "
    "--dynamo_backend no --main_process_port 29612 -m agents.cli"
)


def train_as_torchrun_does(folder: Path) -> None:
    assert main([*KEYS.split(), f"prior={folder / 'base'}", f"output={folder / 'torchrun'}"]) == 0


def train_as_accelerate_does(folder: Path) -> None:
    """The launcher's own module in this process; what the two that it starts print goes to a file.

    They are copies of this process with the launcher's variables, as a new interpreter imports for seconds.
    """
    for name in ("MASTER_ADDR", "MASTER_PORT", "WORLD_SIZE", "RANK"):
        del os.environ[name]
    os.environ |= {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    with (folder / "told").open("w") as told:
        os.dup2(told.fileno(), 1)
    module, *options = LAUNCHER.split()
    sys.argv = [module, *options, *KEYS.split(), f"prior={folder / 'base'}", f"output={folder / 'accelerate'}"]
    subprocess_handler.Popen = _forked  # type: ignore[misc, assignment]
    runpy.run_module(module, run_name="__main__")


def _forked(args: Sequence[str], env: Mapping[str, str], **_: Any) -> ForkedModule:
    """What stands for ``python -u -m agents.cli ...``."""
    command = [word for word in args if word != "-u"]
    return ForkedModule(command, pass_fds=(), env=env, start_new_session=True, stdout=1)


@pytest.mark.slow
def test_accelerate_gives_the_run_of_torchrun(tmp_path: Path) -> None:
    pytest.importorskip("accelerate")
    tiny_prior().save(tmp_path / "base")
    assert in_processes(train_as_accelerate_does, tmp_path, count=1) == [0]
    assert (tmp_path / "told").read_text().count("sample it: scene-envs sample") == 1  # one writer
    assert in_processes(train_as_torchrun_does, tmp_path) == [0, 0]
    one, other = (
        torch.load(tmp_path / name / CHECKPOINT_NAME, weights_only=True)["learner"]["prior"]
        for name in ("accelerate", "torchrun")
    )
    assert one.keys() == other.keys()
    assert all(torch.equal(one[key], other[key]) for key in one)


def test_accelerate_on_a_cpu_that_starts_one_process_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    monkeypatch.setenv("ACCELERATE_USE_CPU", "True")
    assert ProcessGroup.join().size == 1  # one was asked for
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    with pytest.raises(InvalidInputError, match="give --multi_gpu in place of --cpu"):
        ProcessGroup.join()


def join_as_open_mpi_does(folder: Path) -> None:
    for name, known in (("WORLD_SIZE", "SIZE"), ("RANK", "RANK")):
        os.environ[f"OMPI_COMM_WORLD_{known}"] = os.environ.pop(name)
    first = is_first_process()
    assert launched_processes() == 2
    group = ProcessGroup.join(timeout=60.0)
    assert group.is_first == first
    (folder / str(group.rank)).write_text(str(group.sum(torch.tensor([10.0**group.rank])).tolist()))


@pytest.mark.slow
def test_processes_of_open_mpi_find_each_other(tmp_path: Path) -> None:
    assert in_processes(join_as_open_mpi_does, tmp_path) == [0, 0]
    assert [(tmp_path / str(rank)).read_text() for rank in (0, 1)] == ["[11.0]", "[11.0]"]
