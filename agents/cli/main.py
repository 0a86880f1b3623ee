"""The command line: ``scene-envs COMMAND key=value …``.

Exit status 0: done; 1: the work failed; 2: the input was wrong. An error is one paragraph on stderr, with a
traceback only under ``--traceback`` or ``SCENE_ENVS_TRACEBACK=1``.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import functools
import itertools
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from agents.cli.commands import COMMANDS, load_command
from agents.cli.keys import compose, format_rows, help_text, keys_of, read_override
from agents.cli.run_folder import RESUMING, Run, fresh_directory
from agents.configuration.composition import config_text, known_masks, known_rewards
from agents.configuration.prior_names import find_prior, split_name
from agents.utils.interrupts import Terminated, terminable
from scene_envs import __version__
from scene_envs.arrays import resolve_device
from scene_envs.errors import (
    CorruptFileError,
    InvalidInputError,
    SceneEnvsError,
    StorageError,
    TrainingError,
    UnknownNameError,
    unknown_name,
)
from scene_envs.files import find_scenes
from scene_envs.registry import ALLOWED, FILES, PluginError, run_file
from scene_envs.scene_types import list_scene_types

DONE, FAILED, WRONG_INPUT, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143

_SPINS = "3000"
"""Turns that an idle thread of OpenMP waits before it sleeps (``GOMP_SPINCOUNT``)."""
_MAX_TEXT = 4000
"""Characters of an error message."""
_USAGE = """\
usage: scene-envs COMMAND key=value ...

{commands}

scene-envs COMMAND --help lists the keys of a command; --traceback shows where an error came from.
--cfg job prints the keys and runs nothing; --config FILE starts the run of a config.yaml again;
--config-dir FOLDER adds groups and experiments (+experiment=NAME); --multirun seed=0,1,2 makes a run of each.
--allow-local allows reward=./mine.py:clutter, mask=./mine.py:top, … to run that file without a question.
A command writes into output=FOLDER, by default runs/COMMAND-TIME.
"""
_FLAGS = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
for _names in (["--config-dir"], ["--config"], ["--cfg", "-c"]):
    _FLAGS.add_argument(*_names, default="")
for _names in (["--allow-local"], ["--multirun", "-m"], ["--help", "-h"]):
    _FLAGS.add_argument(*_names, action="store_true")
_DEVICE = (
    r"(auto|cpu|cuda|mps|xpu|hpu|mtia|xla|ipu|hip|ve|vulkan|maia|lazy|meta|privateuseone|npu|mlu|musa|mkldnn|opengl|opencl|"
    r"ideep|fpga)(:\d{1,4})?"
)
"""Devices that torch knows, and their automatic choice."""
_DATASETS = ("data", "heldout", "regularisation.scenes")
_GRAMMAR = "grammar"
_FROM_FILES = ("scene", "mask", "masks", "planner", "algorithm", "network")
"""Keys whose components a file may register; rewards (``reward``, ``objective``) load their files themselves."""
_FILE = re.compile(r"(?P<path>[^\s,\[\]{}'\":][^,\[\]{}'\":]*\.py):(?P<name>[A-Za-z_]\w*)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; ``argv`` replaces the words of the process after ``scene-envs``."""
    return _guarded(argv, _dispatch)


def main_of(command: str, meaning: str, module: ModuleType, argv: Sequence[str] | None = None) -> int:
    """Run a program that consists of one command, and return its exit status.

    ``command`` is its name in messages and in the name of its folder, ``meaning`` what it does, in one phrase, and
    ``module`` has ``run(settings, run)``, as those of :mod:`agents.cli.commands`.
    """
    return _guarded(argv, lambda words: _run_or_help(command, meaning, module, words))


def _guarded(argv: Sequence[str] | None, work: Callable[[list[str]], int]) -> int:
    """The exit status of ``work``, whose errors become one paragraph on stderr."""
    words = list(sys.argv[1:] if argv is None else argv)
    show_traceback = os.environ.get("SCENE_ENVS_TRACEBACK", "") not in ("", "0")
    if "--traceback" in words:
        show_traceback = True
        words.remove("--traceback")
    signals: list[int] = []
    try:
        with terminable(signals):
            _check_text(words)
            return work(words)
    except Terminated as error:
        return _ended(TERMINATED, str(error))
    except KeyboardInterrupt as error:
        return _ended(INTERRUPTED, str(error))
    except BrokenPipeError:  # the reader of our output has gone, as in `scene-envs rewards | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except Exception as error:
        if show_traceback:
            traceback.print_exc()
        # some code turns Terminated into another error
        if signals and not isinstance(error, StorageError | TrainingError):
            return _ended(TERMINATED)
        return _complain(*_verdict(error))


def _check_text(words: Sequence[str]) -> None:
    """Refuse words that cannot be written to a file as text, such as names of files in another encoding."""
    for word in words:
        if not word.isprintable() and ("\0" in word or word.encode(errors="replace").decode() != word):
            raise InvalidInputError(f"{ascii(word)[:200]} is no text in UTF-8; give files and folders another name")


def _ended(status: int, what_now: str = "") -> int:
    what = "terminated" if status == TERMINATED else "interrupted"
    return _complain(f"{what}; {what_now}" if what_now else what, status)


def entry_point() -> None:
    """Run as a program, in which idle threads of OpenMP sleep after a short wait unless the environment says otherwise:
    threads that wait busily take processor time from those for which they wait, where other work shares the cores.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)  # read when torch loads OpenMP
    sys.exit(main())


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help", "help"):
        print(_USAGE.format(commands=format_rows(list(COMMANDS.items()))), end="")
        return DONE if words else WRONG_INPUT
    if words[0] == "--version":
        print(f"scene-envs {__version__}")
        return DONE
    command, *rest = words
    if command not in COMMANDS:
        raise unknown_name("command", command, COMMANDS)
    return _run_or_help(f"scene-envs {command}", COMMANDS[command], load_command(command), rest)


def _run_or_help(program: str, meaning: str, module: ModuleType, words: list[str]) -> int:
    try:
        flags, words = _FLAGS.parse_known_args(words)
    except argparse.ArgumentError as error:
        name = str(error.argument_name).partition("/")[0]
        wrong = "takes no value" if "explicit" in error.message else f"needs a value behind it, as in {name} VALUE"
        raise InvalidInputError(f"{name} {wrong}") from None
    config_dir, file, shown, sweep = flags.config_dir, flags.config, flags.cfg, flags.multirun
    if shown not in ("", "job"):
        raise InvalidInputError(f"--cfg {shown}: only --cfg job is known, which prints the keys and runs nothing")
    command = program.removeprefix("scene-envs ")
    named = _named(words, getattr(module, "POSITIONAL", ()))
    named = [_without_file(word, flags.allow_local) for word in named]
    keys = keys_of(module)
    if flags.help:
        config = keys if sweep or not named else compose(command, keys, named, config_dir, file)
        print(f"{program}: {meaning}.\n\n{help_text(config, named, config_dir)}")
        return DONE
    if sweep and not getattr(module, "WRITES", True):
        raise InvalidInputError(f"--multirun: {command} writes no folder; run it once for each value")
    variants = expand_sweeps(named) if sweep else [(named, "")]
    runs = [(compose(command, keys, variant, config_dir, file), label) for variant, label in variants]
    for settings, _ in runs if not shown else ():
        _check(settings, module, flags.allow_local)
    folder = ""
    for settings, label in runs:
        if sweep:  # each run has a folder of its own below ``output``
            folder = settings.output or folder or fresh_directory(command)
            settings = replace(settings, output=str(Path(folder) / label))
            print(f"{'# ' * bool(shown)}{command} {label}", flush=True)
        _run(command, module, settings, bool(shown))
    return DONE


def _without_file(word: str, allow_local: bool) -> str:
    """The word with ``NAME`` for each ``PATH.py:NAME``, whose file has run and registered the component ``NAME``."""
    key, _, value = word.partition("=")
    if key.partition(".")[0] not in _FROM_FILES or ".py:" not in value:
        return word

    def run(found: re.Match[str]) -> str:
        path = Path(found["path"]).expanduser().resolve()
        _ask_for_file(key, path, allow_local)
        try:
            run_file(path)
        except PluginError as error:
            raise InvalidInputError(f"{key}={found[0]}: {error}") from error
        others = os.environ.get(FILES, "").split(os.pathsep)
        os.environ[FILES] = os.pathsep.join(dict.fromkeys(filter(None, [*others, str(path)])))
        return found["name"]

    return f"{key}={_FILE.sub(run, value)}"


def _ask_for_file(key: str, path: Path, allow_local: bool) -> None:
    if not path.is_file():
        raise InvalidInputError(f"{key}=: there is no file {str(path)!r}")
    if path in ALLOWED:
        return
    if not allow_local and sys.stdin is not None and sys.stdin.isatty():
        print(f"{key}= runs the file {path}. Run it? [y/N] ", end="", file=sys.stderr, flush=True)
        allow_local = sys.stdin.readline().strip().lower() in ("y", "yes")
    if not allow_local:
        raise InvalidInputError(f"{key}= would run the file {str(path)!r}; add --allow-local if you trust it")
    ALLOWED.add(path)


def _run(command: str, module: ModuleType, settings: Any, only_show: bool) -> None:
    if only_show:
        print(config_text(settings), end="")
    elif not getattr(module, "WRITES", True):
        module.run(settings)
    else:
        settings = settings if settings.output else replace(settings, output=fresh_directory(command))
        with Run(command, settings) as run:
            try:
                module.run(settings, run)
            except KeyboardInterrupt as error:
                same = f"the same command with output={settings.output}"
                goes_on = f"{same} goes on where this one ended"
                begins = f"{command} keeps no partial work, so {same} begins anew"
                raise type(error)(goes_on if command in RESUMING else begins) from error


def _named(words: Sequence[str], keys: Sequence[str]) -> list[str]:
    """The words; each one without ``=`` gets the next of ``keys`` in front, and stays as it is when none is left."""
    left = iter(keys)
    return [word if "=" in word else f"{key}={word}" if (key := next(left, "")) else word for word in words]


def _verdict(error: Exception) -> tuple[str, int]:
    """The message for the user, and the exit status."""
    if isinstance(error, InvalidInputError | UnknownNameError | CorruptFileError):
        return str(error), WRONG_INPUT
    if isinstance(error, RecursionError):
        return f"a value or a file is nested too deeply ({_cut(error)}); write it flatter", WRONG_INPUT
    if isinstance(error, SceneEnvsError):
        return str(error), FAILED
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"the disk is full{_at(error)}; finished files are kept: make room and run again", FAILED
    if isinstance(error, OSError) and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"the operating system allows no access{_at(error)}; put that right, or give another output", FAILED
    if isinstance(error, OSError):
        return f"the operating system refused: {_cut(error)}", FAILED
    if isinstance(error, MemoryError) or "can't allocate memory" in str(error) or "out of memory" in str(error):
        return f"not enough memory ({_cut(error)}); give smaller sizes, such as batch_size=", FAILED
    return (
        f"something unexpected happened, {type(error).__name__}: {_cut(error)}. "
        "Run again with --traceback to see where, and please report it",
        FAILED,
    )


def _at(error: OSError) -> str:
    return f" at {error.filename!r}" if error.filename else ""


def _cut(message: object) -> str:
    text = str(message)
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}..."


def _complain(text: str, status: int) -> int:
    with contextlib.suppress(OSError):  # stderr may be closed
        print(f"scene-envs: {_cut(text)}".encode(errors="backslashreplace").decode(), file=sys.stderr)
    return status


def expand_sweeps(words: Sequence[str]) -> list[tuple[list[str], str]]:
    """All combinations of the values of swept words, as Hydra writes them, each with a name for its folder.

    >>> expand_sweeps(["seed=0,1", "reward=object_count"])
    [(['seed=0', 'reward=object_count'], 'seed=0'), (['seed=1', 'reward=object_count'], 'seed=1')]
    """
    choices = [_values(word) for word in words]
    runs = []
    for number, combination in enumerate(itertools.product(*choices)):
        swept = [word for word, options in zip(combination, choices, strict=True) if len(options) > 1]
        label = ",".join(swept)
        plain = all(character.isalnum() or character in "=,._-+" for character in label)
        runs.append((list(combination), label if swept and plain and len(label) < 100 else str(number)))
    return runs


def _values(word: str) -> list[str]:
    """The word, once for every value that it sweeps over."""
    parsed = read_override(word)
    if parsed is None or not parsed.is_sweep_override():
        return [word]
    key = word.partition("=")[0]
    return [f"{key}={value}" for value in parsed.sweep_string_iterator()]


# Checks of values that need no torch: names, paths and numbers


def _check(settings: Any, module: ModuleType, allow_local: bool) -> None:
    """Refuse wrong values that can be found before the work starts; ask before one of the user's files is run."""
    if (own := getattr(module, "check", None)) is not None:
        own(settings)
    if (prior := getattr(settings, "prior", None)) and isinstance(prior, str):
        own_name, adapters = split_name(prior)
        find_prior(own_name)
        for part in adapters.split("+") if adapters and not os.path.exists(adapters) else ():
            find_prior(part.rpartition("*")[2].strip())
    for key in ("reward", "objective"):
        _check_name("reward", getattr(settings, key, None), known_rewards)
    if (scene := getattr(settings, "scene", None)) is not None and not isinstance(scene, str):
        raise InvalidInputError(f"scene={str(scene)[:200]}: give the name of one scene type, or several joined by +")
    for scene in str(getattr(settings, "scene", "") or "").split("+"):
        _check_name("scene type", scene, list_scene_types)
    for mask in [getattr(settings, "mask", None), *(getattr(settings, "masks", None) or [])]:
        _check_name("mask", mask, known_masks)
    device = getattr(settings, "device", "auto")
    if not re.fullmatch(_DEVICE, device):
        raise InvalidInputError(f"device={device[:60]!r} is no torch device; give auto, cpu, cuda or cuda:1")
    if (scenes := getattr(settings, "scenes", None)) and isinstance(scenes, str):
        find_scenes(Path(scenes))
    resumed = os.path.exists(Path(str(getattr(settings, "output", "") or "."), "checkpoint.pt"))
    kept = {"regularisation.scenes"} if resumed else set()  # a resumed run has them in its folder
    for key in set(_DATASETS) - kept - set(getattr(settings, "NO_PATHS", ())):
        _check_dataset(key, functools.reduce(lambda value, part: getattr(value, part, None), key.split("."), settings))
    if getattr(settings, "prompt", None) == "":
        raise InvalidInputError("prompt= is empty; give a text, or null for no prompt")
    if (physics := getattr(settings, "physics", "auto")) != "auto":  # what auto takes is said in the log of the run
        from scene_envs.physics.engines import engine_name

        engine_name(physics)
    for key in ("reward", "objective"):
        if "/" in (text := str(getattr(settings, key, ""))) or ".py:" in text:
            from rewards.registry import local_files

            for path in local_files(getattr(settings, key)):
                _ask_for_file(key, path, allow_local)
    if device not in ("auto", "cpu"):  # neither needs torch to be checked
        resolve_device(device)


def _check_name(kind: str, value: Any, known: Callable[[], Sequence[str]]) -> None:
    """Refuse a name that no component has."""
    name = value.get("name") if isinstance(value, dict) else value
    if kind != "reward" and isinstance(name, str) and _FILE.fullmatch(name):
        raise InvalidInputError(
            f"{kind} {name!r}: in a file of keys, write the name alone, and list the Python file in the environment "
            f"variable {FILES}"
        )
    if isinstance(name, str) and name.isidentifier() and name not in (names := known()):
        raise unknown_name(kind, name, names)


def _check_dataset(key: str, value: Any) -> None:
    if not isinstance(value, str):
        return
    parts = [part.strip() for part in value.split(",")]
    if value and not any(parts):
        raise InvalidInputError(f"{key}={value[:200]!r} names no dataset; scene-envs generate makes one")
    for part in filter(None, parts):
        if part != _GRAMMAR and not os.path.exists(part):
            raise InvalidInputError(
                f"{key}={value[:200]!r}: nothing is at {part[:200]!r}; name a dataset, as scene-envs generate makes one"
            )
