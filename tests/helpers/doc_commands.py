"""Shell commands of the documentation: run in this process with small sizes, or read where they cannot be run."""

from __future__ import annotations

import shutil
from importlib import import_module
from types import ModuleType

from agents import cli
from agents.cli.commands import COMMANDS, load_command
from agents.cli.keys import describe_fields, keys_of
from agents.post_training.settings import default_algorithm
from tests.helpers.doc_folders import prepare
from tests.helpers.doc_pages import INSTEAD, NOT_RUN, ROOT, ROWS, SMALL_KEYS


def run_command(words: list[str], prepared: tuple[str, ...]) -> None:
    """Run one command, a folder of ``prepared`` that it writes being its own to make."""
    name, main, rest = _program(words)
    if main is None:
        check_words(words)
        return
    small = _small(name, rest)
    for word in small:
        key, _, value = word.partition("=")
        if key == "output" and value in prepared and name in ("generate", "pretrain"):
            shutil.rmtree(value, ignore_errors=True)
    assert main.main([*([name] if main is cli else []), *small]) == 0, " ".join(words)


def check_words(words: list[str]) -> None:
    """Check a command without running it: its program or target exists, and the keys are those of the command."""
    if words[0] == "make":
        assert f"\n{words[1]}:" in (ROOT / "Makefile").read_text(encoding="utf-8")
    elif words[0] == "hf":
        assert words[1] == "download"
    elif words[0] in ("bash", "python") and words[1] != "-m":
        assert (ROOT / words[1]).is_file(), words[1]
    else:
        name, main, rest = _program(words)
        assert main is not None, words
        if main is cli:
            assert name in {*COMMANDS, "COMMAND"}, name
        given = {word.partition("=")[0] for word in rest if "=" in word}
        assert name == "COMMAND" or given <= _keys(name), words


def _program(words: list[str]) -> tuple[str, ModuleType | None, list[str]]:
    """The command's name, the module whose ``main`` runs it, None for what is not run, and its other words."""
    if words[0] in NOT_RUN:
        return words[0], None, words[1:]
    if words[0] == "scene-envs":
        return words[1] if len(words) > 1 else "--help", cli, words[2:]
    start = words.index("-m") + 1  # of python or torchrun
    if words[start] == "agents.cli":
        return words[start + 1], cli, words[start + 2 :]
    return words[start], _run_by_python(words[start]), words[start + 1 :]


def _run_by_python(name: str) -> ModuleType:
    """What ``python -m NAME`` runs: a module, or the ``__main__`` of a package."""
    module = import_module(name)
    return import_module(f"{name}.__main__") if hasattr(module, "__path__") else module


def _keys(name: str) -> set[str]:
    """The keys of a command or of a program, and the names of its groups."""
    if "." in name:
        module = _run_by_python(name)
        if hasattr(module, "PARTS"):  # each key says how often
            return {*module.PARTS, "rows", "seed"}
        if hasattr(module, "DEFAULTS"):
            return set(module.DEFAULTS)
    else:
        module = load_command(name)
    keys = {key.name for key in describe_fields(keys_of(module))}
    return keys | {key.rpartition(".")[0] for key in keys}


def _small(name: str, words: list[str]) -> list[str]:
    """The words of a command with small sizes, and with what this machine has."""
    keys = _keys(name)
    sizes = {key: value for key, value in SMALL_KEYS.get(name, {}).items() if key in keys}
    if "scenes" in {word.partition("=")[0] for word in words} and name != "view":
        sizes.pop("count", None)
        sizes.pop("slots", None)  # the scenes have their own
    chosen = dict(word.partition("=")[::2] for word in words)
    if name == "post-train" and ("algorithm" in chosen or default_algorithm(chosen.get("reward")) != "ddpo_sf"):
        sizes.pop("algorithm.gradient_steps", None)  # of DDPO alone
    if name == "post-train" and any(word.startswith("prompt=") for word in words):
        sizes.pop("slots", None)  # prompts of real scenes ask for as many objects as those have
        sizes["logger.report_scenes"] = "0"  # the prior with text is untrained; its heaps take minutes to come apart
    kept = [word for word in words if word.partition("=")[0] not in sizes]
    for old, new in INSTEAD.items():
        for position, word in enumerate(kept):
            if word.endswith(f"={old}"):
                kept[position] = word.removesuffix(old) + new
    for word in kept:
        if word == "text=bert":
            prepare("models/bert-base")
    if "text=bert" in kept and not any(word.startswith("text.encoder=") for word in kept):
        kept.append("text.encoder=models/bert-base")  # in place of the hub's
    typed = dict(word.split("=", 1) for word in words if "=" in word)
    given = {"data": typed.get("data", ""), "rows": typed.get("rows", ROWS).replace("*", "")}
    return [*kept, *(f"{key}={value.format(**given)}" for key, value in sizes.items())]
