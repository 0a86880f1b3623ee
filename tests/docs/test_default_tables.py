"""Tables of keys and their defaults on the pages of algorithms and of the guard."""

from __future__ import annotations

import re
from typing import Any

import pytest

from agents.post_training import PostTrainConfig
from tests.helpers.doc_pages import ROOT

ALGORITHMS = {
    "ddpo_sf": "ddpo_sf",
    "ddpo_is": "ddpo_is",
    "nft": "nft",
    "awm": "awm",
    "guidance_distillation": "guidance_distillation",
    "refinement": "refinement",
}
"""Algorithm of each page below ``docs/algorithms``."""
PAGES = {**{f"docs/algorithms/{page}.md": name for page, name in ALGORITHMS.items()}, "docs/guard.md": "nft"}
_ROW = re.compile(r"^\| `((?:algorithm|regularisation|optimizer|guard)\.\w+)` \| ([^|]+) \|", re.MULTILINE)


def rows(page: str) -> dict[str, str]:
    """The keys of the tables with a column of defaults, and these defaults."""
    tables = (ROOT / page).read_text(encoding="utf-8").split("\n\n")
    return {key: value for table in tables if "| key | default |" in table for key, value in _ROW.findall(table)}


def same(text: str, value: Any) -> bool:
    """Whether the text of a table gives the value."""
    return text == value if isinstance(value, str) else float(text) == value


@pytest.mark.parametrize(("page", "algorithm"), PAGES.items())
def test_tables_give_the_defaults(page: str, algorithm: str) -> None:
    config: Any = PostTrainConfig(algorithm=algorithm)  # type: ignore[arg-type]
    found = rows(page)
    assert len(found) >= 2
    for key, text in found.items():
        group, name = key.split(".")
        assert same(text.strip(), getattr(getattr(config, group), name)), f"{page}: {key} is {text}"
