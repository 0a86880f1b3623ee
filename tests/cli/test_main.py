"""The command line as a user meets it: help, values, errors, early checks, trusted folders, exit status."""

from __future__ import annotations

import ast
import io
import os
import subprocess
import sys
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import yaml

from agents.cli import main
from agents.cli.commands import COMMANDS, load_command
from agents.cli.keys import describe_fields, keys_of
from agents.configuration.composition import MEASURE_NAMES, known_masks, known_rewards
from agents.planning.ledger import _PLANNERS
from agents.pretraining.settings import NETWORKS, registered_networks
from agents.priors import list_priors
from rewards import list_rewards
from rewards import registry as local_files
from rewards.registry import registered_module
from scene_envs import get_scene_type, list_masks
from scene_envs.envs.masks import _MASKS
from scene_envs.errors import PhysicsError
from scene_envs.grammars import list_grammars
from scene_envs.scene_types import _SCENE_TYPES

MAIN = import_module("agents.cli.main")
"""The module; ``agents.cli.main`` is its function."""


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
    monkeypatch.setattr(MAIN, "main", lambda: 3)
    with pytest.raises(SystemExit) as ended:
        MAIN.entry_point()
    assert (ended.value.code, os.environ.get("GOMP_SPINCOUNT")) == (3, spins)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_every_key_with_its_meaning(command, capsys):
    assert main([command, "--help"]) == 0
    assert COMMANDS[command] in capsys.readouterr().out
    keys = describe_fields(keys_of(load_command(command)))
    assert all(key.meaning for key in keys), [key.name for key in keys if not key.meaning]


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from agents.cli import main\n"
        f"for command in {list(COMMANDS)}: main([command, '--help'])\n"
        "main(['post-train', 'reward=clutter', 'algorithm=nft', 'prior=dimsum_table', '--help'])\n"
        "main(['search', 'planner=mcts', 'mask=culprits', 'prompt=a cup', 'count=3', '--help'])\n"
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
        (["evaluate", "adaptor=runs/a"], "unknown evaluate key 'adaptor'; did you mean 'adapter'?"),
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


@pytest.mark.slow
@pytest.mark.parametrize("words", [["check-reward", "reward"], ["search", "mask"], ["post-train", "algorithm"]])
def test_a_file_that_raises_when_it_is_imported_exits_2(words, tmp_path, capsys):
    (file := tmp_path / "mine.py").write_text("raise ValueError('no table')\n")
    outputs = [] if words[0] == "check-reward" else [f"output={tmp_path / 'out'}"]
    assert main([words[0], f"{words[1]}={file}:mine", "--allow-local", *outputs]) == 2
    assert capsys.readouterr().err.strip().endswith("cannot be run: ValueError: no table")


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
    monkeypatch.setattr(MAIN, "load_command", lambda name: command)
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
        (["sample", "reward=./mine.py:few"], "reward=: there is no file"),
        (["sample", f"reward={__file__}:few"], "add --allow-local if you trust it"),
    ],
)
def test_values_that_no_key_expects_are_refused_in_a_few_words(words, message, capsys, tmp_path):
    assert main([*words, f"output={tmp_path}"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err) < 1000


LINES = {
    "view scene=[1,2]": "give the name of one scene type",
    "generate scene={a:b}": "give the name of one scene type",
    "evaluate data=,": "names no dataset",
    f"sample guidance={'9' * 400}": "guidance=",
    f"pretrain loss.noise.mean={'9' * 400}": "mean=",
    "evaluate workers=-1": "workers=-1 must be at least 0",
    "evaluate prior=dimsum_tabel": "did you mean 'dimsum_table'",
    "evaluate prior=runs/nowhere": "'runs/nowhere' holds no prior",
    "evaluate measures=layuot": "did you mean 'layout'",
    "evaluate measures=3": "measures=3 is no list of names",
    "evaluate data=nowhere": "data='nowhere': nothing is at 'nowhere'",
    "evaluate prompt_count=1": "prompt_count=1 must be from 2 to count=200",
    "evaluate count=0": "count=0 must be at least 2",
    "evaluate guidance=nan": "guidance=nan must be a finite number",
    "doctor reward=object_cuont": "did you mean 'object_count'",
    "doctor regularisation.scenes=nowhere": "regularisation.scenes='nowhere': nothing is at 'nowhere'",
    "doctor algorithm.credit=objects": "did you mean 'object'",
    "generate progress=bars": "did you mean 'bar'",
    "doctor slots=0": "slots=0 must be at least 1",
    "post-train device=cuad": "device='cuad' is no torch device",
    "post-train optimizer.lr=nan": "lr=nan must be a positive number",
    "search objective=object_cuont": "did you mean 'object_count'",
    "search scenes=nowhere": "no scene file, run or dataset is there",
    "search planner=baem": "did you mean 'beam'",
    "search planner=gradient planner.planner=baem": "did you mean 'beam'",
    "search mask=culprit": "did you mean 'culprits'",
    "search mask={name:culprit,at_least:2}": "did you mean 'culprits'",
    "post-train reward={name:clpi,reward:object_count,high:3}": "did you mean 'clip'",
    "search adapter=nowhere prior=dimsum_table": "unknown prior 'nowhere'",
    "demo workers=-3": "workers=-3 must be at least 0",
    "generate count=0": "count=0 must be at least 1",
    "generate shard_size=0": "shard_size=0 must be at least 1",
    "generate scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "generate backend=rya": "did you mean 'ray'",
    "sample count=0": "count=0 must be at least 1",
    "sample num_steps=-5": "num_steps=-5 must be at least 1",
    "sample batch_size=0": "batch_size=0 must be at least 1",
    "sample slots=0": "slots=0 must be at least 1, or null",
    "sample eta=nan": "eta=nan must be at least 0",
    "sample reward_limits={timeout:0}": "reward_limits.timeout=0.0 must be a positive number",
    "sample guidance=2": "guidance=2 strengthens a prompt",
    "sample claim_guidance=2": "claim_guidance=2 guides scenes to the claims of a prompt",
    "search claim_guidance=2": "give prompt=, or leave claim_guidance=0",
    "rearrange prior=dimsum_table claim_guidance=-1": "claim_guidance=-1.0 must be a finite number",
    "evaluate claim_guidance=nan": "claim_guidance=nan must be at least 0",
    "sample physics_guidance=2": "physics_guidance=2.0 must be a number from 0 to 1",
    "search physics_guidance=-1": "physics_guidance=-1.0 must be a number from 0 to 1",
    "complete prior=dimsum_table physics_guidance=nan": "physics_guidance=nan must be a number from 0 to 1",
    "evaluate physics_guidance=1.1": "physics_guidance=1.1 must be a number from 0 to 1",
    "export prior=dimsum_table physics_guidance=2": "physics_guidance=2.0 must be a number from 0 to 1",
    "view prior=dimsum_table physics_guidance=-1": "physics_guidance=-1.0 must be a number from 0 to 1",
    "sample union=one": "did you mean 'one_type'",
    "sample export=drkae": "did you mean 'drake'",
    "complete": "name a scene file, run or dataset",
    "complete scenes=nowhere": "no scene file, run or dataset is there",
    "complete scenes=nowhere prior=dimsum_table": "no scene file, run or dataset is there",
    "rearrange prior=dimsum_table count=0": "count=0 must be at least 1, or null",
    "complete prior=dimsum_table fill=-1": "fill=-1 must be at least 0",
    "project": "name a scene file, run or dataset",
    "project scenes=nowhere": "no scene file, run or dataset is there",
    "export scenes=nowhere": "no scene file, run or dataset is there",
    "export prior=dimsum_table formats=drkae": "did you mean 'drake'",
    "export prior=dimsum_table friction=-1": "friction=-1.0 must be at least 0",
    "export": "name either a scene file, run or dataset",
    "render": "name a scene file, run or dataset",
    "render scenes=nowhere": "no scene file, run or dataset is there",
    "render scenes=nowhere depth=tiff": "unknown depth 'tiff'",
    "render scenes=nowhere modes=[rgb,dept]": "give some of rgb, depth, instance, category, normals, semantic",
    "view": "say what to show",
    "view scene=dimsum_table first=-1": "first=-1 must be at least 0",
    "view scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "pretrain data=nowhere": "data='nowhere': nothing is at 'nowhere'",
    "pretrain data=grammar scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "pretrain process.schedule=karas": "did you mean 'karras'",
    "pretrain loss.observed_share=2": "observed_share=2.0 is outside 0..1",
    "package-prior prior=dimsum_table output=x precision=float12": "unknown precision 'float12'",
    "import-checkpoint a.ckpt metadata.json": "'a.ckpt' is no file",
    "check-reward scene=dimsum_tabel": "did you mean 'dimsum_table'",
    "priors prior=dimsum_tabel": "did you mean 'dimsum_table'",
}
REWARDS = {
    "{name:clip,reward:clutter,high:x}": "clip: high='x' must be a finite number, or null",
    "{name:clip,reward:clutter,high:nan}": "clip: high=nan must be a finite number, or null",
    "{name:clip,reward:clutter,high:inf}": "clip: high=inf must be a finite number, or null",
    "{name:weighted_sum,rewards:[clutter],weights:[x]}": "weighted_sum: weights='x' must be a finite number",
    "{name:weighted_sum,rewards:[clutter],weights:[nan]}": "weighted_sum: weights=nan must be a finite number",
    "{name:weighted_sum,rewards:[clutter],weights:3}": "'weights': 3}: 'int' object is not iterable; its settings are",
    "{name:weighted_sum,rewards:[clutter],offset:x}": "weighted_sum: offset='x' must be a finite number",
    "{name:product,rewards:3}": "made with {'rewards': 3}: object of type 'int' has no len(); its settings are",
    "{name:reachability,opening:x}": "reachability: opening='x' must be a positive number",
    "{name:reachability,sides:3}": "made with {'sides': 3}: 'int' object is not iterable; its settings are",
    "{name:category_count,assets:3}": "made with {'assets': 3}: 'int' object is not iterable; its settings are",
    "{name:prompt_match,prompt:3}": "prompt_match: prompt=3 is not a text or null",
    "{name:[clip]}": "reward=['clip'] is neither a name",
    "{name:[clip],high:3}": "a reward mapping needs 'name' (or '_target_'), a text, got {'name': ['clip'], 'high': 3}",
    "{name:clip}": "missing 1 required positional argument: 'reward'; its settings are",
    "./nowhere.py:few": "reward=: there is no file",
}
WRONG_KEYS = {
    "post-train iterations=a": "iterations=a is not a whole number",
    "sample count=x": "count=x is not a whole number",
    "search budgte=3": "unknown search key 'budgte'",
    "pretrain optimizer.lr=-1": "lr=-1.0 must be",
}


@pytest.mark.slow
def test_names_paths_and_numbers_are_refused_without_torch():
    code = (
        "import sys\nfrom agents.cli import main\n"
        f"assert [main(line.split()) for line in {list(WRONG_KEYS)!r}] == [2] * {len(WRONG_KEYS)}\n"
        "assert not {'torch', 'matplotlib', 'pybullet'} & set(sys.modules)\n"
        f"for line in {list(LINES)!r}:\n"
        "    assert main(line.split()) == 2, line\n    assert 'torch' not in sys.modules, line"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for line, told in zip((WRONG_KEYS | LINES).values(), done.stderr.splitlines(), strict=True):
        assert line in told


@pytest.mark.parametrize(("reward", "message"), REWARDS.items())
def test_settings_of_rewards_of_a_wrong_type_are_named(reward, message, capsys):
    assert main(["check-reward", f"reward={reward}", "scene=dimsum_table", "--allow-local"]) == 2
    err = capsys.readouterr().err
    assert message in err
    assert len(err.strip().splitlines()) == 1


def test_no_dataset_is_named(tmp_path, capsys):
    assert main(["pretrain", "data=", f"output={tmp_path}"]) == 2
    assert "data= names no dataset; scene-envs generate makes one" in capsys.readouterr().err


def test_the_names_that_are_known_without_torch_are_those_of_the_packages():
    own = {name for name in list_rewards() if (registered_module(name) or "").startswith("rewards.")}
    assert len(own) > 10
    assert len(list_priors()) > 8
    code = (
        "from agents.configuration.composition import known_masks, known_rewards\n"
        "from scene_envs import list_scene_types\n"
        "print([known_masks(), known_rewards(), list_scene_types()])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    masks, rewards, scenes = ast.literal_eval(done.stdout)
    assert own <= set(rewards) <= set(list_rewards()) == set(known_rewards())
    assert set(masks) <= set(list_masks()) == set(known_masks())
    assert {"culprits", "off_prompt", "random"} <= set(masks)
    assert set(scenes) <= set(list_grammars())
    assert set(NETWORKS) <= set(registered_networks())


def test_words_of_groups_are_those_of_the_parts_they_are_for():
    from agents.diffusion.categorical import CATEGORICAL_KERNELS, UNMASKINGS
    from agents.diffusion.gaussian import LOSS_WEIGHTINGS, PREDICTIONS, SCHEDULES, TIMESTEP_DISTRIBUTIONS
    from agents.evaluation.measure import MEASURES
    from agents.networks.denoisers import EMPTY_SLOTS
    from agents.networks.flux import TEXT_REACHES
    from agents.pretraining.settings import FluxSettings, LossSettings, ProcessSettings
    from agents.priors.config import CATEGORY_LOSSES, PROCESSES
    from agents.priors.continuous import ROTATION_WIDTHS

    assert tuple(MEASURES) == MEASURE_NAMES
    for make, key, known in (
        (ProcessSettings, "name", PROCESSES),
        (ProcessSettings, "prediction", PREDICTIONS),
        (ProcessSettings, "schedule", SCHEDULES),
        (ProcessSettings, "rotation", ROTATION_WIDTHS),
        (ProcessSettings, "kernel", CATEGORICAL_KERNELS),
        (ProcessSettings, "empty_slots", EMPTY_SLOTS),
        (ProcessSettings, "unmasking", UNMASKINGS),
        (LossSettings, "timesteps", TIMESTEP_DISTRIBUTIONS),
        (LossSettings, "weighting", LOSS_WEIGHTINGS),
        (LossSettings, "category", CATEGORY_LOSSES),
        (FluxSettings, "text_reach", TEXT_REACHES),
    ):
        for word in known:
            assert getattr(make(**{key: word}), key) == word


@pytest.mark.parametrize("word", ["output=\udcff", "prior=\udcff", "title=\udcff\n", "output=a\0b", "\ud800=1"])
def test_words_that_are_no_text_are_refused(word, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sample", word]) == 2
    assert "is no text in UTF-8" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


REWARD_FILE = "def few(batch):\n    return -batch.counts.float()\n"


@pytest.fixture
def reward_files(tmp_path, monkeypatch):
    """Two files of rewards; what is allowed in a test is forgotten after it."""
    allowed: set[Path] = set()
    for module in (local_files, MAIN):
        monkeypatch.setattr(module, "ALLOWED", allowed)
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
    local_files.ALLOWED.clear()
    assert main(["sample", word, "--allow-local"]) == 0


def test_a_file_is_asked_about_once(reward_files, monkeypatch, capsys):
    file = reward_files / "one.py"
    answered(monkeypatch, "y")
    monkeypatch.setenv("SCENE_ENVS_FILES", "")
    assert main(["search", f"masks=[{file}:few, {file}:few]", f"objective={file}:few"]) == 2  # it registers no mask
    said = capsys.readouterr().err
    assert said.count("Run it?") == 1
    assert "unknown mask 'few'" in said


def test_a_yes_to_one_file_is_no_yes_to_another(reward_files, monkeypatch, capsys):
    both = f"reward={{name: weighted_sum, rewards: ['{reward_files}/one.py:few', '{reward_files}/two.py:few']}}"
    answered(monkeypatch, "y", "n")
    assert main(["sample", both]) == 2
    err = capsys.readouterr().err
    assert err.count("Run it?") == 2
    assert "two.py'; add --allow-local" in err


COMPONENTS = """
from dataclasses import dataclass, replace

from agents.planning import GreedyPlanner, register_planner
from scene_envs import get_scene_type, register_mask, register_scene_type


@register_mask("upper_of_file")
def upper(scene, score, rng):
    return scene.is_free[0] & (scene.translations[0, :, 2] > 0.1)


@register_planner("greedy_of_file")
@dataclass(frozen=True)
class Greedy(GreedyPlanner):
    name: str = "greedy_of_file"


register_scene_type(replace(get_scene_type("pantry_shelf"), name="pantry_of_file"))
"""


def test_masks_planners_and_scene_types_come_from_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCENE_ENVS_FILES", "")
    file = tmp_path / "mine.py"
    file.write_text(COMPONENTS)
    words = ["search", f"masks=[{file}:upper_of_file, empty]", f"planner={file}:greedy_of_file"]
    monkeypatch.setattr("sys.stdin", io.StringIO())
    assert main(words) == 2
    assert "mine.py'; add --allow-local if you trust it" in capsys.readouterr().err
    assert main([*words, "--allow-local", "--cfg", "job"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert shown["masks"] == ["upper_of_file", "empty"]
    assert shown["planner"]["name"] == "greedy_of_file"
    assert main(["generate", f"scene={file}:pantry_of_file", "--allow-local", "--cfg", "job"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["scene"] == "pantry_of_file"
    assert main(["search", f"mask={file}:lower", "--allow-local"]) == 2
    assert "unknown mask 'lower'" in capsys.readouterr().err
    spaced = tmp_path / "my files" / "mine.py"
    assert main(["search", f"mask={spaced}:lower", "--allow-local"]) == 2
    assert f"there is no file {str(spaced)!r}" in capsys.readouterr().err
    (tmp_path / "keys.yaml").write_text(f"mask: {file}:upper_of_file\n")
    assert main(["search", "--config", str(tmp_path / "keys.yaml")]) == 2
    assert "list the Python file in the environment variable SCENE_ENVS_FILES" in capsys.readouterr().err
    assert main(["search", f"mask={tmp_path}/other.py:lower", "--allow-local"]) == 2
    assert "there is no file" in capsys.readouterr().err
    for registry, name in ((_MASKS, "upper"), (_PLANNERS, "greedy"), (_SCENE_TYPES, "pantry")):
        registry.pop(f"{name}_of_file")


def test_processes_that_a_command_starts_know_the_scene_types_of_its_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SCENE_ENVS_FILES", "")
    file = tmp_path / "mine.py"
    file.write_text(
        "from dataclasses import replace\nfrom scene_envs import get_scene_type, register_scene_type\n"
        "register_scene_type(replace(get_scene_type('pantry_shelf'), name='pantry_of_file'))\n"
    )
    assert main(["generate", f"scene={file}:pantry_of_file", "--allow-local", "--cfg", "job"]) == 0
    code = "from scene_envs import get_scene_type; print(get_scene_type('pantry_of_file').slots)"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(child.stdout) == get_scene_type("pantry_shelf").slots
