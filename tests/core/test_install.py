"""Installation by ``make``: progress, further tries, repair after a kill; pip and interpreter are played."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

CI = Path(__file__).resolve().parents[2] / ".ci"
PLAY = """
import json, os, sys, time
from pathlib import Path
tries = Path({folder!r}, "tries.json")
number = len(json.loads(tries.read_text())) if tries.exists() else 0
tries.write_text(json.dumps([*(json.loads(tries.read_text()) if number else []), sys.argv[1:]]))
{script}
"""
RETRYING = (
    "WARNING: Retrying (Retry(total={left})) after connection broken by 'NewConnectionError(\"Pool(port=443): "
    "Failed to establish a new connection\")': /simple/torch/"
)


@pytest.fixture
def installer() -> ModuleType:
    spec = importlib.util.spec_from_file_location("install_with_pip", CI / "install.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Play:
    """An installer whose pip runs a script, which knows the ``number`` of its try."""

    def __init__(self, installer: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.installer, self.folder, self.monkeypatch = installer, folder, monkeypatch
        self.packages, self.scratch = folder / "site-packages", folder / "tmp"
        self.packages.mkdir()
        self.scratch.mkdir()

    def record(self, name: str, finished: bool = True) -> Path:
        """A package among those installed."""
        folder = self.packages / f"{name}.dist-info"
        folder.mkdir()
        (folder / "METADATA").touch()
        if finished:
            (folder / "INSTALLER").write_text("pip\n")
        return folder

    def run(self, script: str, silence: float = 5.0) -> int:
        code = PLAY.format(folder=str(self.folder), script=script)
        self.monkeypatch.setattr(self.installer, "PIP", (sys.executable, "-c", code))
        status: int = self.installer.install(
            ["-e", "."], self.scratch, self.packages, pauses=(0.0, 0.0), silence=silence
        )
        return status

    @property
    def tries(self) -> int:
        return len(json.loads((self.folder / "tries.json").read_text()))


@pytest.fixture
def play(installer: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Play:
    return Play(installer, tmp_path, monkeypatch)


def test_a_file_that_comes_slowly_shows_how_much_of_it_is_there(play: Play, capfd: pytest.CaptureFixture[str]) -> None:
    script = """
print("  Downloading https://a.b/c/torch-2.13.0%2Bcpu-cp311.whl (191.8 MB)", flush=True)
folder = Path(os.environ["TMPDIR"], "pip-unpack-x")
folder.mkdir()
Path(folder, "torch-2.13.0+cpu-cp311.whl").write_bytes(bytes(2_500_000))
time.sleep(0.5)
"""
    assert play.run(script, silence=0.1) == 0
    assert "torch: 2.5 of 191.8 MB" in capfd.readouterr().out


def test_packages_that_are_written_are_counted(play: Play, capfd: pytest.CaptureFixture[str]) -> None:
    play.record("pip-26.3")
    script = f"""
print("Installing collected packages: a, b, c", flush=True)
time.sleep(0.2)
folder = Path({str(play.packages)!r}, "a-1.dist-info")
folder.mkdir()
Path(folder, "INSTALLER").touch()
time.sleep(0.4)
"""
    assert play.run(script, silence=0.1) == 0
    shown = capfd.readouterr().out
    assert "0 of 3 packages installed" in shown
    assert "1 of 3 packages installed" in shown


def test_a_lost_connection_ends_in_a_further_try_and_no_traceback(
    play: Play, capfd: pytest.CaptureFixture[str]
) -> None:
    script = """
if number == 0:
    print("ERROR: Exception:\\nTraceback (most recent call last):\\n  File x\\nReadTimeoutError: Read timed out.")
    sys.exit(2)
print("Successfully installed torch-2.13.0")
"""
    assert play.run(script) == 0
    shown = capfd.readouterr()
    assert play.tries == 2
    assert "Traceback" not in shown.out + shown.err
    assert "The network failed: ReadTimeoutError: Read timed out." in shown.out
    assert "Successfully installed torch-2.13.0" in shown.out


def test_a_network_that_stays_away_ends_in_one_sentence(play: Play, capfd: pytest.CaptureFixture[str]) -> None:
    lines = [RETRYING.format(left=left) for left in range(4, -1, -1)]
    script = f"""
for line in {lines!r}:
    print(line)
print("ERROR: Could not find a version that satisfies the requirement torch (from versions: none)")
sys.exit(1)
"""
    assert play.run(script) == 1
    shown = capfd.readouterr()
    assert play.tries == 3
    assert shown.err.startswith("The network failed 3 times: Failed to establish a new connection\n")
    assert "from versions" not in shown.out + shown.err
    assert shown.out.count("pip tries again") == 3  # one line a try, of five that pip says


def test_other_errors_are_passed_on_and_not_tried_again(play: Play, capfd: pytest.CaptureFixture[str]) -> None:
    script = """
print("ERROR: No matching distribution found for torch>=99")
sys.exit(1)
"""
    assert play.run(script) == 1
    assert play.tries == 1
    assert "No matching distribution found for torch>=99" in capfd.readouterr().out


def test_a_pip_that_can_resume_is_told_to(play: Play) -> None:
    old = play.record("pip-23.2.1")
    assert "--resume-retries" not in play.installer.Pip([], play.scratch, play.packages, 1.0).command
    old.rename(play.packages / "pip-26.3.dist-info")
    assert "--resume-retries" in play.installer.Pip([], play.scratch, play.packages, 1.0).command


def test_records_of_a_killed_installation_are_removed(play: Play) -> None:
    kept, broken = play.record("numpy-2.4.6"), play.record("sympy-1.14.0", finished=False)
    aside = play.packages / "~orch"
    aside.mkdir()
    assert play.installer.repair(play.packages) == ["sympy-1.14.0"]
    assert (kept.is_dir(), broken.exists(), aside.exists()) == (True, False, False)


@pytest.mark.parametrize("state", ["none", "without pip", "whole"])
def test_an_environment_that_was_not_made_to_its_end_is_made_anew(tmp_path: Path, state: str) -> None:
    """With an interpreter that is played: it says that it is Python 3.11, and notes what it is called with."""
    interpreter = tmp_path / "python3.11"
    interpreter.write_text('#!/bin/sh\nif [ "$1" = -c ]; then echo 3.11; else echo "$@" > called; fi\n')
    interpreter.chmod(0o755)
    if state != "none":
        python = tmp_path / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(f"#!/bin/sh\nexit {int(state != 'whole')}\n")
        python.chmod(0o755)
    subprocess.run(["sh", str(CI / "make-venv"), str(interpreter)], cwd=tmp_path, check=True)
    called = tmp_path / "called"
    assert (called.read_text().strip() if called.exists() else None) == (
        None if state == "whole" else "-m venv --clear .venv"
    )
