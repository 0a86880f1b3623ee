"""Report of a run: one self-contained HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.post_training.run_files import write_text

if TYPE_CHECKING:
    from jinja2 import Template


@dataclass(frozen=True)
class Picture:
    """An image of the page.

    Attributes:
        path: PNG file; its bytes go into the page.
        caption: one line below.
    """

    path: Path
    caption: str


@dataclass(frozen=True)
class Tile:
    """A headline number.

    Attributes:
        label: what it is.
        value: as text.
        note: what it is compared with.
    """

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A heading with text, pictures (two stand side by side) and a table.

    Attributes:
        title: heading.
        text: one paragraph.
        pictures: images.
        table: rows of cells; the first is the head.
    """

    title: str
    text: str = ""
    pictures: Sequence[Picture] = ()
    table: Sequence[Sequence[str]] = ()


@dataclass(frozen=True)
class Page:
    """Content of a report.

    Attributes:
        title: heading of the page.
        lead: what was done, in a sentence or two.
        tiles: headline numbers.
        sections: in order.
        settings: shown folded at the end.
    """

    title: str
    lead: str
    tiles: Sequence[Tile] = ()
    sections: Sequence[Section] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)


def write_report(path: Path, page: Page) -> Path:
    """Write ``page`` as one self-contained HTML file: styles and pictures inside, no script, no link."""
    write_text(path, render_page(page))
    return path


def render_page(page: Page) -> str:
    """The HTML of ``page``; all text is escaped.

    >>> "<h1>a &lt; b</h1>" in render_page(Page("a < b", ""))
    True
    """
    from markupsafe import Markup

    style = resources.files("agents.utils").joinpath("report.css").read_text(encoding="utf-8")
    return _template().render(page=page, style=Markup(style))


@cache
def _template() -> Template:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("agents", "post_training")
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    environment.filters["png"] = lambda path: base64.b64encode(path.read_bytes()).decode("ascii")
    return environment.get_template("report.html")
