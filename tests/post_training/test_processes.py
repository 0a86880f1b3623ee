"""Post-training on several processes: the steps of one, what happens where processes end, and launchers."""

from __future__ import annotations

import csv
import os
import runpy
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from filelock import FileLock
from torch.distributed.elastic.multiprocessing.subprocess_handler import subprocess_handler

from agents.cli.main import main
from agents.post_training import PostTrainer, post_train
from agents.post_training.run_files import CHECKPOINT_NAME
from agents.priors.testing import tiny_prior
from agents.utils.process_group import ProcessGroup, is_first_process, launched_processes
from rewards.base import RewardContext, RewardOutput
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.scene import SceneBatch
from tests.helpers.batch_reward import AboveTheMean
from tests.helpers.forked import ForkedModule
from tests.helpers.processes import Run, in_processes, train
from tests.helpers.small_runs import small_config

TWO = ["A scene with two cups.", "A scene with 9 objects."]
CASES: dict[str, tuple[str, torch.dtype, dict[str, Any]]] = {
    "ddpo_sf": ("continuous", torch.float64, {"algorithm": {"gradient_steps": 2}}),
    "ddpo_is": (
        "mixed",
        torch.float64,
        {
            "algorithm": {"updates": 2, "scenes_per_prompt": 3},
            "prompt": TWO,
            "reward": AboveTheMean(),
            "iterations": 1,
        },
    ),
    "nft": (
        "mixed",
        torch.float64,
        {
            "iterations": 1,
            "optimizer.lr": 1e-4,
            "regularisation.objective": "discriminative",
            "regularisation.weight": 0.5,
            "regularisation.base_samples": 8,
        },
    ),
    "awm": (
        "continuous",
        torch.float32,
        {"guard": {"action": "rollback", "limit": 0.5, "every": 1, "scenes": 20, "samples": 20}, "bank_size": 30},
    ),
    "guidance_distillation": (
        "mixed",
        torch.float64,
        {"algorithm": {"updates": 1, "states": 6}, "prompt": TWO, "iterations": 1, "slots": 12},
    ),
    "refinement": (
        "mixed",
        torch.float64,
        {"algorithm": {"updates": 2, "states": 6}, "iterations": 1, "slots": 12},
    ),
}
"""Algorithm: the process of the prior, the dtype, and further keys."""


def full_scenes(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Objects per scene with credit per object; scenes with a multiple of five are invalid."""
    return RewardOutput(batch.counts.float(), (~batch.is_empty).float(), valid=batch.counts % 5 > 0)


def fails_elsewhere(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Objects per scene with credit and a term; raises in all processes but the first."""
    if os.environ["RANK"] != "0":
        raise ValueError("not here")
    return RewardOutput(batch.counts.float(), (~batch.is_empty).float(), {"objects": batch.counts.float()})


def runs(folder: Path, chunk: int | None) -> list[Run]:
    """One of every case, of six scenes each iteration."""
    made = []
    for name, (process, dtype, keys) in CASES.items():
        keys = {
            "reward": full_scenes,
            "iterations": 2,
            "chunk": chunk,
            "regularisation.batch_size": 6,
            **keys,
        }
        keys["algorithm"] = {"name": name, **keys.get("algorithm", {})}
        made.append((small_config(folder / name, **keys), process, dtype))
    return made


def state(folder: Path) -> dict[str, Any]:
    """What a resumed run needs, but for the state of torch's own generator, which no step reads."""
    found: dict[str, Any] = torch.load(folder / "checkpoint.pt", weights_only=True)
    return {key: value for key, value in found["learner"].items() if key != "random"}


def log(folder: Path) -> list[dict[str, str]]:
    """The rows without their times."""
    rows = csv.DictReader((folder / "log.csv").open())
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


def difference(one: Any, other: Any) -> float:
    """The largest difference of the tensors and numbers in two states."""
    if isinstance(one, Mapping):
        assert one.keys() == other.keys()
        one, other = list(one.values()), list(other.values())
    if isinstance(one, list | tuple):
        return max((difference(a, b) for a, b in zip(one, other, strict=True)), default=0.0)
    if isinstance(one, torch.Tensor) and one.numel():
        return float((one.double() - other.double()).abs().max())
    return abs(one - other) if isinstance(one, float) else float(not isinstance(one, torch.Tensor) and one != other)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every case on two processes, and on one that takes half of the batch at a time."""
    path = tmp_path_factory.getbasetemp()
    path = (path.parent if "PYTEST_XDIST_WORKER" in os.environ else path) / "processes"  # one for all workers
    with FileLock(f"{path}.lock"):
        if not (path / "done").exists():
            failing = small_config(path / "failing", reward=fails_elsewhere, iterations=1), "continuous", torch.float32
            train(runs(path / "one", chunk=3))  # first: the copies know what it imported and drew
            assert in_processes(train, [*runs(path / "two", chunk=None), failing]) == [0, 0]
            (path / "done").touch()
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_two_processes_take_the_steps_of_one_bit_for_bit(folder: Path, name: str) -> None:
    assert difference(state(folder / "two" / name), state(folder / "one" / name)) == 0.0
    for row, expected in zip(log(folder / "two" / name), log(folder / "one" / name), strict=True):
        assert row.keys() == expected.keys()
        for key, value in row.items():
            assert float(value or 0) == pytest.approx(float(expected[key] or 0), rel=1e-6, abs=1e-9, nan_ok=True), key


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tolerance"), [("nft", 1e-13), ("awm", 1e-6)])
def test_one_process_that_takes_the_batch_at_once_differs_by_rounding(
    folder: Path, tmp_path: Path, name: str, tolerance: float
) -> None:
    train(run for run in runs(tmp_path, chunk=None) if run[0].algorithm.name == name)
    assert difference(state(tmp_path / name)["prior"], state(folder / "two" / name)["prior"]) < tolerance


def train_and_die(run: Run, note: Path) -> None:
    """The second process ends in the third iteration; the first notes what it says and how long it took."""
    step = PostTrainer.step

    def dying(self: PostTrainer) -> Any:
        if self.iteration == 2 and not self.processes.is_first:
            os._exit(9)
        return step(self)

    PostTrainer.step = dying  # type: ignore[method-assign]
    try:
        train([run])
    except TrainingError as error:
        note.write_text(str(error))
        raise SystemExit(1) from None


@pytest.mark.slow
def test_a_run_goes_on_after_a_process_died(tmp_path: Path) -> None:
    def run(name: str) -> Run:
        return small_config(tmp_path / name, chunk=3, **{"regularisation.batch_size": 6}), "continuous", torch.float32

    assert in_processes(train_and_die, run("two"), tmp_path / "note") == [1, 9]
    assert "another process of this run ended" in (tmp_path / "note").read_text()
    assert len(log(tmp_path / "two")) == 2
    train([run("two"), run("one")])  # one process goes on with what two began
    assert difference(state(tmp_path / "two"), state(tmp_path / "one")) == 0.0
    assert log(tmp_path / "two") == log(tmp_path / "one")


def wait_in_vain(note: Path) -> None:
    """The second process comes, and then never answers."""
    processes = ProcessGroup.join(timeout=2.0)
    if not processes.is_first:
        while not note.exists():
            time.sleep(0.05)
        return
    try:
        processes.wait()
    except TrainingError as error:
        note.write_text(str(error))


@pytest.mark.slow
def test_a_process_that_does_not_answer_ends_the_wait(tmp_path: Path) -> None:
    assert in_processes(wait_in_vain, tmp_path / "note") == [0, 0]
    assert "did not answer in time" in (tmp_path / "note").read_text()


@pytest.mark.slow
def test_a_reward_that_fails_in_one_process_makes_its_rows_invalid(folder: Path) -> None:
    rows = log(folder / "failing")
    assert [float(row["valid_fraction"]) for row in rows] == [0.5]
    assert all(float(row["term_objects"]) == float(row["reward"]) > 1 for row in rows)


@pytest.mark.parametrize(
    ("processes", "message"),
    [
        (4, "batch_size=6 is not a multiple of 4, the number of processes; give batch_size=4 or 8"),
        (3, None),
        (8, "give batch_size=8, or another number of processes"),
    ],
)
def test_a_batch_that_cannot_be_parted_is_refused_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, processes: int, message: str | None
) -> None:
    monkeypatch.setenv("WORLD_SIZE", str(processes))
    config = small_config(tmp_path / "run")
    with pytest.raises(InvalidInputError, match=message or "cannot connect"):  # the latter: nothing set MASTER_ADDR
        post_train(config, prior=tiny_prior())
    assert not (tmp_path / "run").exists()


def test_several_processes_need_one_folder(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert main(["post-train", "iterations=1"]) == 2
    assert "give output=, such as runs/post-train" in capsys.readouterr().err


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
