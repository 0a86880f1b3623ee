"""Worker processes: modules come from where this process has them, never from the current folder."""

import subprocess
import sys
from pathlib import Path

import pytest
from scene_envs.worker_processes import module_command, module_environment

from rewards import IsolatedReward, allow_local_rewards, evaluate_reward
from scene_envs import SceneBatch
from scene_envs.datasets import generate
from scene_envs.physics import PhysicsPool, feasibility


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with files named like modules; the file that is there once one of them was imported."""
    sprung = tmp_path / "sprung"
    for name in ("scene_envs", "rewards", "numpy", "torch", "runpy", "signal"):
        (tmp_path / f"{name}.py").write_text(f"open({str(sprung)!r}, 'w')\nraise SystemExit('trap')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    return sprung


def test_a_module_runs_with_its_words_and_not_that_of_the_current_folder(trap: Path) -> None:
    done = subprocess.run(module_command("json.tool", "--help"), env=module_environment(), capture_output=True)
    assert done.returncode == 0
    assert b"json" in done.stdout
    done = subprocess.run(module_command("scene_envs.worker_processes"), env=module_environment(), capture_output=True)
    assert done.returncode == 0, done.stderr
    assert not trap.exists()


@pytest.mark.slow
def test_workers_import_nothing_from_the_current_folder(trap: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def few(batch):\n    return -batch.counts\n")
    allow_local_rewards("mine.py")
    with PhysicsPool(workers=1) as pool:
        assert feasibility(SceneBatch.empty("dimsum_table", 2), pool=pool).valid.all()
    with IsolatedReward("./mine.py:few") as reward:
        assert evaluate_reward(reward, SceneBatch.empty("dimsum_table", 2)).is_valid.all()
    generate("dimsum_table", 2, tmp_path / "data", workers=1, shard_size=1, progress=False)
    assert not trap.exists()
