"""Files of users' rewards on the command line: run after a flag or a yes, and after nothing else."""

import io
from importlib import import_module

import pytest

from agents.cli import main
from rewards import registry as local_files

MAIN = import_module("agents.cli.main")
"""The module; ``agents.cli.main`` is its function."""

REWARD_FILE = "def few(batch):\n    return -batch.counts.float()\n"


@pytest.fixture
def reward_files(tmp_path, monkeypatch):
    """Two files of rewards; what is allowed in a test is forgotten after it."""
    monkeypatch.setattr(local_files, "_allowed", set())
    monkeypatch.setattr(MAIN, "_run", lambda *_: 0)  # what is tested comes before the work
    for name in ("one.py", "two.py"):
        (tmp_path / name).write_text(REWARD_FILE)
    return tmp_path


def answered(monkeypatch, *answers):
    """A terminal at which these lines are typed."""
    terminal = io.StringIO("".join(f"{answer}\n" for answer in answers))
    monkeypatch.setattr(terminal, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stdin", terminal)


def test_the_file_of_a_reward_runs_after_a_flag_or_a_yes(reward_files, monkeypatch, capsys):
    word = f"reward={reward_files}/one.py:few"
    monkeypatch.setattr("sys.stdin", io.StringIO())  # no terminal, nobody to ask
    assert main(["sample", word]) == 2
    assert "add --allow-local if you trust it" in capsys.readouterr().err
    answered(monkeypatch, "n")
    assert main(["sample", word]) == 2
    assert "one.py. Run it? [y/N]" in capsys.readouterr().err
    answered(monkeypatch, "y")
    assert main(["sample", word, "--cfg", "job"]) == 0  # shown, not run, not asked
    assert "Run it?" not in capsys.readouterr().err
    assert main(["sample", word]) == 0
    assert local_files.allowed_files() == [reward_files / "one.py"]
    assert main(["sample", word]) == 0  # asked once in a process
    local_files._allowed.clear()
    assert main(["sample", word, "--allow-local"]) == 0


def test_a_yes_to_one_file_is_no_yes_to_another(reward_files, monkeypatch, capsys):
    both = f"reward={{name: weighted_sum, rewards: ['{reward_files}/one.py:few', '{reward_files}/two.py:few']}}"
    answered(monkeypatch, "y", "n")
    assert main(["sample", both]) == 2
    err = capsys.readouterr().err
    assert err.count("Run it?") == 2
    assert "two.py'; add --allow-local" in err
