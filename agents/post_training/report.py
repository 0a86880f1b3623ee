"""Report of a run: one self-contained HTML file."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.post_training.run_files import write_text


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
    """All that a report says.

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
    tiles = "".join(
        f'<div class="tile"><span>{_text(t.label)}</span><b>{_text(t.value)}</b><i>{_text(t.note)}</i></div>'
        for t in page.tiles
    )
    sections = "".join(_section(section) for section in page.sections)
    settings = ""
    if page.settings:
        rows = [("setting", "value"), *((key, str(value)) for key, value in page.settings.items())]
        settings = f"<details><summary>All settings</summary>{_table(rows)}</details>"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(page.title)}</title><style>{_STYLE}</style></head><body><main>"
        f'<header><h1>{_text(page.title)}</h1><p class="lead">{_text(page.lead)}</p></header>'
        f'<div class="tiles">{tiles}</div>{sections}{settings}</main></body></html>\n'
    )


def _section(section: Section) -> str:
    parts = [f"<h2>{_text(section.title)}</h2>"]
    if section.text:
        parts.append(f"<p>{_text(section.text)}</p>")
    if section.pictures:
        figures = "".join(_figure(picture) for picture in section.pictures)
        parts.append(f'<div class="{"pair" if len(section.pictures) > 1 else "wide"}">{figures}</div>')
    if section.table:
        parts.append(_table(section.table))
    return f"<section>{''.join(parts)}</section>"


def _figure(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode("ascii")
    caption = _text(picture.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    head, *body = rows
    cells = "".join(f"<th>{_text(cell)}</th>" for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in body)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{lines}</tbody></table></div>'


def _text(value: str) -> str:
    return html.escape(value)


_STYLE = """
:root{--ink:#1c2733;--soft:#5b6875;--line:#e3e7eb;--card:#fff;--page:#f5f6f4;--accent:#0f766e}
@media (prefers-color-scheme:dark){:root{--ink:#e7ebee;--soft:#9aa7b2;--line:#2b343d;--card:#1a2128;--page:#12171c;
--accent:#4fbfb2}img{background:#fff;border-radius:6px}}
*{box-sizing:border-box}
body{margin:0;background:var(--page);color:var(--ink);font:16px/1.6 system-ui,-apple-system,"Segoe UI",sans-serif}
main{max-width:68rem;margin:0 auto;padding:3rem 1.25rem 4rem}
h1{font-size:clamp(1.6rem,4vw,2.4rem);line-height:1.15;letter-spacing:-.02em;margin:0 0 .6rem}
h2{font-size:1.2rem;margin:0 0 .4rem}
p{margin:.2rem 0 1rem;color:var(--soft);max-width:46rem}
.lead{font-size:1.08rem}
section,details{background:var(--card);border:1px solid var(--line);border-radius:14px;padding:1.4rem 1.5rem;
margin-top:1.25rem}
.tiles{display:grid;grid-template-columns:repeat(auto-fit,minmax(11rem,1fr));gap:1rem;margin:1.6rem 0 .2rem}
.tile{background:var(--card);border:1px solid var(--line);border-radius:14px;padding:1rem 1.2rem;
display:flex;flex-direction:column}
.tile span{color:var(--soft);font-size:.85rem}
.tile b{font-size:1.9rem;letter-spacing:-.02em;color:var(--accent);font-variant-numeric:tabular-nums}
.tile i{color:var(--soft);font-style:normal;font-size:.85rem}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(20rem,1fr));gap:1.2rem}
figure{margin:0}
img{width:100%;height:auto;display:block;border-radius:8px}
figcaption{color:var(--soft);font-size:.88rem;margin-top:.45rem}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th{text-align:left;color:var(--soft);font-weight:600;font-size:.85rem}
th,td{padding:.5rem .9rem .5rem 0;border-bottom:1px solid var(--line)}
td:first-child{color:var(--soft)}
tr:last-child td{border-bottom:0}
summary{cursor:pointer;color:var(--soft)}
"""
