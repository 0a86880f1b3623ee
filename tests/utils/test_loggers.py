"""Loggers of a run's figures."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from agents.utils.loggers import LOGGERS, RunLogger
from scene_envs.errors import MissingDependencyError


def test_csv_adds_nothing_to_the_log_of_the_run(tmp_path: Path) -> None:
    logger = RunLogger("csv", tmp_path)
    logger.log({"loss": 0.5}, step=5)
    logger.close()
    assert not list(tmp_path.iterdir())


def test_tensorboard_gets_every_figure_at_its_step(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    logger = RunLogger("tensorboard", tmp_path)
    for step in (5, 10):
        logger.log({"loss": 1.0 / step, "seconds": 0.5 * step}, step)
    logger.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert set(events.Tags()["scalars"]) == {"loss", "seconds"}
    assert [(event.step, event.value) for event in events.Scalars("loss")] == [
        (5, pytest.approx(0.2)),
        (10, pytest.approx(0.1)),
    ]


def test_wandb_stays_on_disk(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    logger = RunLogger("wandb", tmp_path)
    logger.log({"reward": 1.0}, step=1)
    logger.close()
    assert list(tmp_path.glob("wandb/offline-run-*"))


@pytest.mark.parametrize("name", LOGGERS[1:])
def test_a_missing_package_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda package: None)
    with pytest.raises(MissingDependencyError, match=rf"logger={name} needs .*scene-envs\[{name}\]"):
        RunLogger(name, tmp_path)
