"""Report of a run: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.post_training.run_files import write_text
from scene_envs.pages import page_part, page_template


@dataclass(frozen=True)
class Picture:
    """An image of the page.

    Attributes:
        path: PNG file that is embedded in the page.
        caption: one line below the image.
    """

    path: Path
    caption: str


@dataclass(frozen=True)
class Tile:
    """A headline number.

    Attributes:
        label: name of the number.
        value: the number as text.
        note: the value that the number is compared with.
    """

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A heading with text, pictures (in two columns) and a table.

    Attributes:
        title: heading.
        text: one paragraph.
        pictures: images.
        table: rows of cells; the first row is the head.
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
        lead: a sentence or two on the run.
        tiles: headline numbers.
        sections: sections of the page, in order.
        settings: settings of the run, shown folded at the end.
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

    style = Markup(page_part("agents.utils", "report.css"))
    return page_template("agents.post_training", "report.html").render(page=page, style=style)
