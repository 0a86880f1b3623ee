"""The code that the documentation shows: the blocks of a page run in order, in one fresh folder."""

from __future__ import annotations

import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import tomllib
import yaml

from rewards import resolve_reward
from tests.helpers.doc_commands import check_words, run_command
from tests.helpers.doc_folders import prepare
from tests.helpers.doc_pages import (
    NOT_RUN_PYTHON,
    PAGES,
    PREPARED,
    ROOT,
    SMALL,
    SMALLER,
    YAML_FILES,
    Block,
    blocks_of,
    commands_of,
    inline_commands,
    not_run,
    smaller,
)
from tests.helpers.outside_package import EXAMPLE, installed

RUN = ("python", "sh")
READ = ("toml", "yaml", "text")
PAGES_WITH_CODE = [page for page in PAGES if any(block.language in RUN for block in blocks_of(page))]
HISTORY = ("CHANGELOG.md", "benchmarks/research_log.md")
"""Pages that speak of commands as they were."""
PAGES_WITH_COMMANDS = [page for page in PAGES if page not in HISTORY and inline_commands(page)]


@pytest.mark.slow
@pytest.mark.usefixtures("new_interpreters")
@pytest.mark.parametrize("page", PAGES_WITH_CODE)
def test_a_page_runs_from_top_to_bottom(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path / "cache"))
    with ExitStack() as until_the_end:
        run_blocks(page, until_the_end)


def run_blocks(page: str, until_the_end: ExitStack) -> None:
    """Run the blocks of ``page`` below the working directory; what they install stays ``until_the_end``."""
    prepared = PREPARED.get(page, ())
    names: dict[str, Any] = {"__name__": "__main__", "SMALL": SMALL}
    for block in blocks_of(page):
        for name in prepared:
            if name in block.code:
                prepare(name)
        if block.language == "python" and not not_run(block):
            run_python(block, names)
        elif block.language == "sh":
            for words in commands_of(block):
                if words[:2] == ["pip", "install"]:
                    assert (ROOT / words[2]).resolve() == EXAMPLE
                    Path("site").mkdir()
                    until_the_end.enter_context(installed(Path("site").resolve()))
                else:
                    run_command(words, prepared)
        elif block.language == "toml":
            assert "entry-points" in tomllib.loads(block.code)["project"]
        elif block.language == "yaml":
            assert yaml.safe_load(block.code)
            file = Path(YAML_FILES[page])
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(block.code)


def run_python(block: Block, names: dict[str, Any]) -> None:
    code = smaller(block)
    if code.startswith("{"):  # a reward, as it is written in a configuration
        resolve_reward(eval(code, names))
    else:
        padding = "\n" * (block.line - 1)  # errors point into the page
        exec(compile(padding + code, block.page, "exec"), names)


@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS)
def test_commands_in_the_prose_of_a_page_are_right(page: str) -> None:
    for words in inline_commands(page):
        check_words(words)


@pytest.mark.parametrize("page", PAGES)
def test_every_fence_names_a_language(page: str) -> None:
    fences = re.findall(r"^ *```(.*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert set(fences[::2]) <= {*RUN, *READ}
    assert set(fences[1::2]) <= {""}


def test_no_exception_outlives_its_block() -> None:
    """What is replaced, prepared or not run stands on the pages."""
    for page, replaced in SMALLER.items():
        code = "".join(block.code for block in blocks_of(page) if block.language == "python")
        assert [old for old in replaced if old not in code] == [], page
    for page, folders in PREPARED.items():
        code = "".join(block.code for block in blocks_of(page))
        assert [name for name in folders if name not in code] == [], page
    for page, text in NOT_RUN_PYTHON:
        assert any(text in block.code for block in blocks_of(page)), page
