"""Runs side by side: results, processes that end early, and the end of what still runs."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from agents.post_training import post_train
from agents.post_training.side_by_side import post_train_side_by_side
from agents.priors.testing import tiny_prior
from tests.helpers.small_runs import small_config

MODULE = "agents.post_training.side_by_side"


@pytest.mark.slow
@pytest.mark.usefixtures("blank_curves")
def test_results_are_those_of_one_run_after_another(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    configs = {name: small_config(tmp_path / name, reward="object_count", iterations=2) for name in ("one", "two")}
    prior = tiny_prior()
    found = dict(post_train_side_by_side(configs, prior, cores=2))
    alone = post_train(small_config(tmp_path / "alone", reward="object_count", iterations=2), prior=prior)
    for name, result in found.items():
        assert result.directory == tmp_path / name
        assert [row["reward"] for row in result.history] == [row["reward"] for row in alone.history]
        assert result.prior.sample(2, num_steps=3, seed=0).tensor.equal(
            alone.prior.sample(2, num_steps=3, seed=0).tensor
        )
    assert found.keys() == configs.keys()
    assert "stopped" not in capfd.readouterr().err


@pytest.mark.usefixtures("blank_curves")
@pytest.mark.parametrize("cores", [1, 2])
def test_what_a_lost_process_did_not_do_is_done_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], cores: int
) -> None:
    lost = [sys.executable, "-c", "import os; os.write(2, b'no memory\\n'); os._exit(137)"]
    monkeypatch.setattr(f"{MODULE}.module_command", lambda *_: lost)
    configs = {name: small_config(tmp_path / name, reward="object_count", iterations=1) for name in ("one", "two")}
    found = dict(post_train_side_by_side(configs, tiny_prior(), cores=cores))
    assert {name: len(result.history) for name, result in found.items()} == {"one": 1, "two": 1}
    assert capfd.readouterr().err.count(": no memory\n") == (2 if cores == 2 else 0)


@pytest.mark.usefixtures("blank_curves")
def test_runs_that_cannot_be_pickled_follow_one_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def started(*_: str) -> list[str]:
        raise AssertionError("a process was started")

    monkeypatch.setattr(f"{MODULE}.module_command", started)
    reward = lambda batch: batch.counts.float()  # noqa: E731
    configs = {name: small_config(tmp_path / name, reward=reward, iterations=1) for name in ("one", "two")}
    assert [name for name, _ in post_train_side_by_side(configs, tiny_prior(), cores=2)] == ["one", "two"]


def test_closing_ends_the_processes_that_still_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    waits = "import os, sys, time; open(sys.argv[1], 'a').write(f'{os.getpid()} '); sys.stderr.close(); time.sleep(600)"
    pids = tmp_path / "pids"
    monkeypatch.setattr(f"{MODULE}.module_command", lambda *_: [sys.executable, "-c", waits, str(pids)])
    configs = {name: small_config(tmp_path / name, reward="object_count") for name in ("one", "two")}

    def interrupt(_: float) -> None:
        if pids.exists() and len(pids.read_text().split()) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(f"{MODULE}.time", SimpleNamespace(sleep=interrupt))
    with pytest.raises(KeyboardInterrupt):
        list(post_train_side_by_side(configs, tiny_prior(), cores=2))
    for pid in map(int, pids.read_text().split()):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, signal.SIG_DFL)
