"""Output folders of commands: refusal of folders with other results or another writer, and the end on a signal."""

import os
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
import yaml

from agents.cli import main
from agents.configuration.composition import RewardLimitKeys
from agents.priors.testing import tiny_prior
from agents.utils.interrupts import Terminated, finishing_steps, terminable
from scene_envs.files import claimed

pytestmark = pytest.mark.usefixtures("blank_curves")

MAIN = import_module("agents.cli.main")
"""The module; ``agents.cli.main`` is its function."""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Path:
    """A folder that ``sample`` has written."""
    folder = tmp_path_factory.mktemp("drawn")
    tiny_prior().save(folder / "prior")
    assert main([*_words(folder), f"output={folder / 'out'}"]) == 0
    return folder


def _words(folder: Path) -> list[str]:
    return ["sample", f"prior={folder / 'prior'}", "count=2", "num_steps=2", "pictures=0", "workers=0", "reward=null"]


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "log.txt"}


@pytest.mark.parametrize(
    "command",
    ["export", "generate", "pretrain", "post-train", "evaluate", "view", "render", "project", "search", "complete"],
)
def test_the_folder_of_another_command_is_refused_untouched(command, drawn, capsys):
    before = _contents(drawn / "out")
    needed = ["data=grammar"] if command == "pretrain" else []
    needed += [f"scenes={drawn / 'out'}"] if command in ("export", "view", "render", "project", "complete") else []
    assert main([command, *needed, f"output={drawn / 'out'}"]) == 2
    err = capsys.readouterr().err
    assert "of scene-envs sample; give another output" in err
    assert _contents(drawn / "out") == before


def test_the_same_command_with_other_keys_is_refused_and_with_the_same_repeated(drawn, capsys):
    before = _contents(drawn / "out")
    assert main([*_words(drawn), "seed=1", f"output={drawn / 'out'}"]) == 2
    assert "seed was 0, is 1" in capsys.readouterr().err
    assert main([*_words(drawn), "reward={name: clip, reward: object_count, high: 2}", f"output={drawn / 'out'}"]) == 2
    assert "reward.name was None, is 'clip'" in capsys.readouterr().err
    assert main([*_words(drawn), f"output={drawn / 'out'}"]) == 0
    after = _contents(drawn / "out")
    assert {name for name in before if before[name] != after[name]} <= {"metrics.json"}  # holds seconds


def test_the_folder_of_another_command_that_was_ended_early_is_refused(tmp_path, capsys):
    (tmp_path / "log.txt").write_text("2020-01-01 00:00:00 scene-envs search\n")
    (tmp_path / "config.yaml").write_text("budget: 300\n")
    (tmp_path / "search.journal").write_text("{}\n")
    before = _contents(tmp_path)
    assert main(["view", "scene=dimsum_table", "count=1", "pictures=0", f"output={tmp_path}"]) == 2
    assert "holds search.journal of scene-envs search" in capsys.readouterr().err
    assert _contents(tmp_path) == before


def test_the_report_of_another_doctor_is_refused(tmp_path, capsys):
    (tmp_path / "log.txt").write_text("2020-01-01 00:00:00 scene-envs doctor\n")
    (tmp_path / "config.yaml").write_text("seed: 1\n")
    (tmp_path / "metrics.json").write_text("{}\n")
    assert main(["doctor", f"output={tmp_path}"]) == 2
    assert "seed was 1, is 0" in capsys.readouterr().err


def test_a_configuration_that_was_cut_off_is_named_and_nothing_is_written(drawn, capsys):
    path = drawn / "out" / "config.yaml"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"\xff\xfe"):
        path.write_bytes(content)
        before = _contents(drawn / "out")
        assert main([*_words(drawn), f"output={drawn / 'out'}"]) == 2
        assert "config.yaml" in capsys.readouterr().err
        assert _contents(drawn / "out") == before
    path.write_bytes(whole)


def test_a_dataset_made_in_python_is_no_place_for_a_command(tmp_path, capsys):
    (tmp_path / "metadata.json").write_text("{}")
    assert main(["export", "prior=dimsum_table", f"output={tmp_path}"]) == 2
    assert "holds metadata.json of another program" in capsys.readouterr().err


def test_a_command_that_failed_before_it_had_results_may_be_repeated_with_other_keys(tmp_path, capsys):
    assert main(["sample", "prior=nowhere/at_all", f"output={tmp_path}"]) == 2
    tiny_prior().save(tmp_path.parent / "prior")
    words = [f"prior={tmp_path.parent / 'prior'}", *_words(tmp_path)[2:]]
    assert main(["sample", *words, f"output={tmp_path}"]) == 0
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["count"] == 2


def test_a_folder_that_is_being_written_is_refused(drawn, tmp_path, capsys):
    code = (
        "import sys; from scene_envs.files import claimed\n"
        f"with claimed({str(tmp_path)!r}, 'scene-envs sample'): print('held', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as first:
        first.stdout.readline()
        assert main([*_words(drawn), f"output={tmp_path}"]) == 2
        first.kill()
    assert f"is being written by scene-envs sample, process {first.pid}" in capsys.readouterr().err
    assert main([*_words(drawn), f"output={tmp_path}"]) == 0


def test_a_failed_command_lets_go_of_its_folder(tmp_path):
    assert main(["sample", "prior=nowhere/at_all", f"output={tmp_path}"]) == 2
    with claimed(tmp_path, "another"):
        pass
    assert main(["sample", "prior=nowhere/at_all", f"output={tmp_path / 'file'}"]) == 2


def test_sigterm_ends_a_command_like_ctrl_c_with_its_own_status(monkeypatch, tmp_path, capsys):
    class Told:
        WRITES = False

        @staticmethod
        def run(settings: RewardLimitKeys):
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(MAIN, "load_command", lambda name: Told)
    before = signal.getsignal(signal.SIGTERM)
    assert main(["rewards"]) == 143
    assert "terminated" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_sigterm_during_an_import_that_makes_another_error_of_it_ends_a_command_with_status_143(capsys, monkeypatch):
    class Told:
        WRITES = False

        def run(settings: RewardLimitKeys):
            try:
                os.kill(os.getpid(), signal.SIGTERM)
            except KeyboardInterrupt:
                raise ImportError("initialization failed") from None

    monkeypatch.setattr(MAIN, "load_command", lambda name: Told)
    assert main(["rewards"]) == 143
    err = capsys.readouterr().err
    assert "terminated" in err
    assert "unexpected" not in err


def test_a_step_is_finished_before_a_signal_ends_the_run():
    done = []

    def work():
        with terminable(), finishing_steps() as end:
            for step in range(5):
                if step == 1:
                    os.kill(os.getpid(), signal.SIGTERM)
                done.append((step, end.pending))
                end()

    with pytest.raises(Terminated):
        work()
    assert done == [(0, False), (1, True)]


def test_a_second_signal_does_not_wait_for_the_step():
    def work():
        with finishing_steps() as end:
            os.kill(os.getpid(), signal.SIGINT)
            assert end.pending
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("went on")

    with pytest.raises(KeyboardInterrupt):
        work()


@pytest.mark.slow
def test_post_training_saves_when_it_is_told_to_end_and_goes_on_as_if_nothing_had_been(tmp_path, monkeypatch):
    from agents.post_training import post_train
    from agents.post_training.trainer import PostTrainer
    from tests.helpers.small_runs import small_config

    whole = post_train(small_config(tmp_path / "whole"), prior=tiny_prior())
    step = PostTrainer.step

    def ended(self):
        result = step(self)
        if self.iteration == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        return result

    monkeypatch.setattr(PostTrainer, "step", ended)
    with pytest.raises(Terminated), terminable():
        post_train(small_config(tmp_path / "ended"), prior=tiny_prior())
    monkeypatch.undo()
    again = post_train(small_config(tmp_path / "ended"), prior=tiny_prior())
    assert again.history[2]["seconds"] > 0
    rows = [(tmp_path / name / "log.csv").read_text().splitlines() for name in ("whole", "ended")]
    assert [row.split(",")[:3] for row in rows[0]] == [row.split(",")[:3] for row in rows[1]]
    assert len(whole.history) == len(again.history)


def test_a_post_training_log_of_another_run_goes_before_the_first_iteration(tmp_path, monkeypatch):
    from agents.post_training.trainer import PostTrainer
    from tests.helpers.small_runs import small_config

    (tmp_path / "log.csv").write_text("iteration,reward\n1,7.5\n")

    def stopped(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(PostTrainer, "step", stopped)
    with pytest.raises(KeyboardInterrupt):
        PostTrainer(small_config(tmp_path), prior=tiny_prior()).run()
    assert "7.5" not in (tmp_path / "log.csv").read_text()
