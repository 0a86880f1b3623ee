"""Public names of a package that load on first use."""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


def lazy_names(package: str, file: str) -> Callable[[str], Any]:
    """A module's ``__getattr__`` (PEP 562), which imports the names that the module lists under ``if TYPE_CHECKING:``.

    Type checkers and readers see plain imports, which are the only list of names and of the modules that define them.
    ``package`` and ``file`` are ``__name__`` and ``__file__`` of the module, whose source is read at the first lookup.
    """

    @cache
    def homes() -> dict[str, str]:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
        guarded = [node for guard in tree.body if isinstance(guard, ast.If) for node in guard.body]
        imports = [node for node in guarded if isinstance(node, ast.ImportFrom)]
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes()[name]), name)

    return load
