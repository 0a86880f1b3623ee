"""Hooks of the site builder: links into the repository, roles in docstrings, and no sources from the network."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.exceptions import PluginError

ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)")
_REMOTE = re.compile(r"<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)=[\"']?(?:https?:)?//[^>]*>")
_ROLE = re.compile(r":(?:class|data|exc|func|meth|mod):(?=<code>)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files outside the site become their text and path, because the site does not hold those files.

    Raises:
        PluginError: there is no such file in the repository.
    """
    folder = PurePosixPath("docs", page.file.src_uri).parent

    def unlinked(match: re.Match[str]) -> str:
        text, target = match.groups()
        if "://" in target or not (path := _outside(folder, target.partition("#")[0])):
            return match.group(0)
        if not (ROOT / path).exists():
            raise PluginError(f"docs/{page.file.src_uri} links to {target}, and there is no {path}")
        return text if text.strip("`") in (path, PurePosixPath(path).name) else f"{text} (`{path}`)"

    return _LINK.sub(unlinked, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Roles of docstrings, such as ``:func:``, go; the name stays."""
    return _ROLE.sub("", html)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """A page must be readable without a network.

    Raises:
        PluginError: the page loads a script, style, font or picture from elsewhere.
    """
    if found := _REMOTE.search(output):
        raise PluginError(f"docs/{page.file.src_uri} loads from the network: {found.group(0)}")
    return output


def _outside(folder: PurePosixPath, target: str) -> str:
    """The path of ``target`` from the root of the repository, empty when it is inside ``docs``."""
    parts: list[str] = []
    for part in (folder / target).parts:
        if part == "..":
            parts.pop()
        else:
            parts.append(part)
    return "" if parts[0] == "docs" else "/".join(parts)
