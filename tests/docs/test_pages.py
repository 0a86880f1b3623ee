"""The code that the documentation shows: Python blocks run, commands run or are read, page by page."""

from __future__ import annotations

import dataclasses
import re
import shlex
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from pages import (
    GIVEN,
    PAGES,
    PROGRAMS,
    ROOT,
    SKIPPED,
    SMALL_KEYS,
    SMALLER,
    blocks_of,
    commands_of,
    given,
    skipped,
    smaller,
)

from agents.cli import main
from agents.priors.files import list_priors
from rewards import resolve_reward
from scene_envs import get_scene_type

BLOCKS = [block for page in PAGES for block in blocks_of(page)]
PYTHON_PAGES = [page for page in PAGES if any(block.language == "python" for block in blocks_of(page))]
COMMANDS = {
    f"{block.page}:{block.line}: {shlex.join(words)[:60]}": words
    for block in BLOCKS
    if block.language == "sh"
    for words in commands_of(block)
}
FOLDERS = ("/", "FILE")
"""What is in a value that names a file or folder."""


def run_now(words: list[str]) -> bool:
    return words[0] == "scene-envs" and words[1] in SMALL_KEYS


@pytest.mark.slow
@pytest.mark.parametrize("page", PYTHON_PAGES)
def test_python_blocks_run_in_order(page: str, stage: Path) -> None:
    names: dict[str, Any] = {"__name__": "__main__", **given(page)}
    for block in blocks_of(page):
        if block.language == "python" and not skipped(block):
            padding = "\n" * (block.line - 1)  # errors point into the page
            exec(compile(padding + smaller(block), page, "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize("command", [name for name, words in COMMANDS.items() if run_now(words)])
def test_commands_run(command: str, stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, name, *words = COMMANDS[command]
    typed = dict(word.split("=", 1) for word in words)
    fields = {field.name for field in dataclasses.fields(command_module(name).config())}
    small = {key: value for key, value in SMALL_KEYS[name].items() if key in fields}
    if "scenes" in typed:
        small.pop("count", None)
    status = main([name, *(f"{key}={value}" for key, value in (typed | small).items())])
    assert status == 0, capsys.readouterr().err


@pytest.mark.parametrize("command", [name for name, words in COMMANDS.items() if not run_now(words)])
def test_commands_are_right(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every key is one of the command's, every value of its type, and every name of a prior, reward or scene known."""
    monkeypatch.chdir(tmp_path)
    words = COMMANDS[command]
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif words[0] == "bash":
        assert (ROOT / words[1]).is_file()
    elif words[0] == "hf":
        assert words[1] == "download"
    elif words[:2] == ["python", "-m"]:
        check_program(words[2], words[3:], monkeypatch)
    elif words[0] == "torchrun":
        assert words[2:4] == ["-m", "agents.cli"]
        check_command(words[4], words[5:], monkeypatch)
    elif words[1] != "COMMAND":
        assert words[0] == "scene-envs"
        check_command(words[1], words[2:], monkeypatch)


def command_module(name: str) -> ModuleType:
    return import_module(f"agents.cli.commands.{name.replace('-', '_')}")


def check_command(name: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    seen = recorded(command_module(name), monkeypatch)
    assert main([name, *words]) == 0
    check_names(seen)


def check_program(name: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    program = import_module(f"{name}.__main__")
    seen = recorded(program, monkeypatch)
    assert program.main(words) == 0
    check_names(seen)


def recorded(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The settings with which ``module.run`` is called, which does nothing but note them."""
    seen: list[Any] = []
    monkeypatch.setattr(module, "run", lambda settings, *run: seen.append(settings))
    return seen


def check_names(seen: list[Any]) -> None:
    (settings,) = seen
    prior, scene = getattr(settings, "prior", ""), getattr(settings, "scene", "")
    if prior and not any(sign in prior for sign in FOLDERS):
        assert prior in list_priors()
    if scene:
        get_scene_type(scene)
    for key in ("reward", "objective"):
        if getattr(settings, key, None):
            resolve_reward(getattr(settings, key))


def test_no_exception_outlives_its_block() -> None:
    """What is replaced, given or skipped stands on the pages."""
    python = [block for block in BLOCKS if block.language == "python"]
    for page, replaced in SMALLER.items():
        code = "".join(block.code for block in python if block.page == page)
        assert [old for old in replaced if old not in code] == []
    for page, names in GIVEN.items():
        code = "".join(block.code for block in python if block.page == page)
        assert [name for name in names if not re.search(rf"\b{name}\b", code)] == []
    assert [key for key in SKIPPED if not any(key[0] == b.page and key[1] in b.code for b in python)] == []
    known = {"scene-envs", "python", *PROGRAMS}
    assert {words[0] for words in COMMANDS.values()} <= known
