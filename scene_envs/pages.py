"""Templates of self-contained HTML pages, and the styles and scripts that go into them."""

from __future__ import annotations

import base64
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template


@cache
def page_part(package: str, name: str) -> str:
    """The text of a file in the folder of ``package``."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


@cache
def page_template(package: str, name: str, *, trim_blocks: bool = False) -> Template:
    """The template in a file in the folder of ``package``.

    The template escapes all text. Its filter ``png`` gives the bytes of the file at a path in base 64.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=trim_blocks, keep_trailing_newline=not trim_blocks
    )
    environment.filters["png"] = lambda path: base64.b64encode(path.read_bytes()).decode("ascii")
    return environment.from_string(page_part(package, name))
