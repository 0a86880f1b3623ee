"""The command line as a user meets it: help, values, errors, exit status. No work is done here."""

import os
import subprocess
import sys
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import pytest

from agents.cli import main, parser
from agents.cli.commands import COMMANDS
from agents.cli.keys import describe_fields, keys_of
from scene_envs.errors import PhysicsError


def test_without_a_command_it_lists_all_of_them(capsys):
    assert main([]) == 2
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(f"\n  {command}" in printed for command in COMMANDS)


@pytest.mark.parametrize(
    ("given", "spins"), [({}, "3000"), ({"GOMP_SPINCOUNT": "7"}, "7"), ({"OMP_WAIT_POLICY": "active"}, None)]
)
def test_idle_threads_sleep_unless_the_environment_says_otherwise(given, spins, monkeypatch):
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.environ", {**os.environ, **given})
    monkeypatch.setattr(parser, "main", lambda: 3)
    with pytest.raises(SystemExit) as ended:
        parser.entry_point()
    assert (ended.value.code, os.environ.get("GOMP_SPINCOUNT")) == (3, spins)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_every_key_with_its_meaning(command, capsys):
    assert main([command, "--help"]) == 0
    assert COMMANDS[command] in capsys.readouterr().out
    keys = describe_fields(keys_of(import_module(f"agents.cli.commands.{command.replace('-', '_')}")))
    assert all(key.meaning for key in keys), [key.name for key in keys if not key.meaning]


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from agents.cli import main\n"
        f"for command in {list(COMMANDS)}: main([command, '--help'])\n"
        "print({'torch', 'hydra', 'matplotlib', 'pybullet'} & set(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "set()"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["smaple"], "unknown command 'smaple'; did you mean 'sample'?"),
        (["sample", "cuont=3"], "unknown sample key 'cuont'; did you mean 'count'?"),
        (["pretrain", "lr=1"], "unknown pretrain key 'lr'; did you mean 'optimizer.lr'?"),
        (["sample", "count"], "expected key=value, got 'count'"),
        (["sample", "count=three"], "count=three is not a whole number"),
        (["sample", "count=1,2"], "count=1,2 is not a whole number"),
        (["sample", "slots=many"], "slots=many is not a whole number or null"),
        (["sample", "project=perhaps"], "project=perhaps is not true or false"),
        (["sample", "reward={name"], "cannot be read"),
        (["check-reward", "reward=object_cuont"], "did you mean 'object_count'?"),
        (["check-reward", "scene=dimsum_tabel"], "did you mean 'dimsum_table'?"),
        (["generate", "scene=dimsum_tabel", "output=OUT"], "did you mean 'dimsum_table'?"),
        (["sample", "prior=dimsum_tabel", "output=OUT"], "'dimsum_tabel'"),
        (["sample", "reward=feasible_object", "output=OUT"], "did you mean 'feasible_objects'?"),
        (["project", "output=OUT"], "name a scene file"),
        (["project", "scenes=OUT/none.safetensors", "output=OUT"], "no scene file"),
    ],
)
def test_wrong_input_exits_2_with_one_paragraph(words, message, tmp_path, capsys):
    assert main([word.replace("OUT", str(tmp_path / "out")) for word in words]) == 2
    err = capsys.readouterr().err
    assert err.startswith("scene-envs: ")
    assert message in err
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1


def test_an_output_that_is_a_file_exits_2(tmp_path, capsys):
    (tmp_path / "taken").write_text("")
    assert main(["sample", f"output={tmp_path / 'taken'}"]) == 2
    assert "is a file, not a folder" in capsys.readouterr().err


# -- what happens around a command, seen with one of our own -------------------------------------------


@dataclass(frozen=True)
class EchoConfig:
    """Keys of a command that repeats them.

    Attributes:
        text: any text; the docstring goes on
            over two lines.
        number: optional.
        items: a list.
        anything: a name or a mapping.
        output: folder.
    """

    text: str = "plain"
    number: float | None = None
    items: list[int] = field(default_factory=list)
    anything: Any = "name"
    output: str = ""


class EchoCommand:
    """A command module whose work is given by the test."""

    WRITES = True

    def __init__(self) -> None:
        self.seen: list[EchoConfig] = []
        self.work = lambda settings, run: run.write_metrics({"text": settings.text, "nothing": float("nan")})

    def run(self, settings: EchoConfig, run):
        self.seen.append(settings)
        self.work(settings, run)


@pytest.fixture
def echo(monkeypatch):
    """``scene-envs demo`` replaced by a command of our own."""
    command = EchoCommand()
    monkeypatch.setattr(parser, "import_module", lambda name: command)
    return command


@pytest.mark.slow
@pytest.mark.parametrize(
    ("word", "name", "value"),
    [
        ("text=a b, c=d. {e}", "text", "a b, c=d. {e}"),
        ("text=it's", "text", "it's"),
        ("text=null", "text", "null"),
        ("text=", "text", ""),
        ("text=back\\slash", "text", "back\\slash"),
        ("text=C:\\", "text", "C:\\"),
        ("number=1e-3", "number", 1e-3),
        ("number=null", "number", None),
        ("items=[1, 2]", "items", [1, 2]),
        ("items=1,2", "items", [1, 2]),
        ("anything=layout, physics", "anything", ["layout", "physics"]),
        ("anything=object_count", "anything", "object_count"),
        ("anything={name: clip, high: 2.5}", "anything", {"name": "clip", "high": 2.5}),
    ],
)
def test_values_arrive_as_they_were_typed(word, name, value, echo, tmp_path):
    assert main(["demo", word, f"output={tmp_path}"]) == 0
    assert getattr(echo.seen[0], name) == value


def test_a_run_leaves_its_configuration_metrics_and_log(echo, tmp_path):
    assert main(["demo", "text=hello", f"output={tmp_path / 'a' / 'b'}"]) == 0
    folder = tmp_path / "a" / "b"
    assert {path.name for path in folder.iterdir()} == {"config.yaml", "metrics.json", "log.txt"}
    assert "text: hello" in (folder / "config.yaml").read_text()
    assert '"nothing": null' in (folder / "metrics.json").read_text()


def test_a_failed_run_keeps_the_configuration_of_the_run_it_could_not_continue(echo, tmp_path, capsys):
    assert main(["demo", "text=first", f"output={tmp_path}"]) == 0

    def fail(settings, run):
        raise PhysicsError("the workers died")

    echo.work = fail
    assert main(["demo", "text=second", f"output={tmp_path}"]) == 1
    assert "text: first" in (tmp_path / "config.yaml").read_text()
    assert "failed: the workers died" in (tmp_path / "log.txt").read_text()
    assert capsys.readouterr().err == "scene-envs: the workers died\n"


def test_without_an_output_every_run_gets_a_folder_of_its_own(echo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["demo"]) == main(["demo"]) == 0
    assert len({run.output for run in echo.seen}) == 2
    assert all(path.name.startswith("demo-") for path in (tmp_path / "runs").iterdir())


@pytest.mark.parametrize("error", [RuntimeError("surprise"), OSError("No space left on device"), KeyboardInterrupt()])
def test_tracebacks_are_shown_only_when_asked_for(error, echo, tmp_path, capsys, monkeypatch):
    def fail(settings, run):
        raise error

    echo.work = fail
    status = main(["demo", f"output={tmp_path}"])
    assert status == (130 if isinstance(error, KeyboardInterrupt) else 1)
    err = capsys.readouterr().err
    assert str(error) in err
    assert len(err.strip().splitlines()) == 1
    if isinstance(error, Exception):
        main(["demo", f"output={tmp_path}", "--traceback"])
        monkeypatch.setenv("SCENE_ENVS_TRACEBACK", "1")
        main(["demo", f"output={tmp_path}"])
        assert capsys.readouterr().err.count("Traceback") == 2


def test_a_docstring_over_two_lines_is_one_sentence():
    meanings = {key.name: key.meaning for key in describe_fields(EchoConfig)}
    assert meanings["anything"] == "a name or a mapping."
    assert "goes on over two lines." in meanings["text"]


@pytest.mark.slow
def test_wrong_keys_are_told_before_anything_heavy_is_loaded():
    lines = [
        ["post-train", "iterations=a"],
        ["sample", "count=x"],
        ["search", "budgte=3"],
        ["pretrain", "optimizer.lr=-1"],
    ]
    code = (
        "import sys; from agents.cli import main\n"
        f"print([main(line) for line in {lines}], {{'torch', 'matplotlib', 'pybullet'}} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[2, 2, 2, 2] set()"


@pytest.mark.parametrize("text", ["${oc.env:HOME}", "a ${b} \\${c}", "${", "$HOME"])
def test_text_that_looks_like_an_interpolation_is_text(text, echo, tmp_path):
    assert main(["demo", f"text={text}", f"output={tmp_path}"]) == 0
    assert echo.seen[0].text == text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sample", "count=" + "9" * 5000], "cannot be read"),
        (["sample", "seed=" + "9" * 30], "whole numbers end at 2^63"),
        (["sample", "seed=-1"], "seed=-1 must be from 0"),
        (["sample", "device=banana"], "device='banana' is no torch device"),
        (["view", "scene=1e999"], "is neither a name nor a mapping"),
        (["project", "scenes=" + "a" * 300], "no scene file, run or dataset is there"),
        (["sample", "reward=./mine.py:few"], "add --allow-local if you trust it"),
    ],
)
def test_values_that_no_key_expects_are_refused_in_a_few_words(words, message, capsys, tmp_path):
    assert main([*words, f"output={tmp_path}"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err) < 1000
