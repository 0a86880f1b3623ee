"""Imports between the modules of the three packages, read from their source.

Every import counts: at the top of a module, inside a function and under ``TYPE_CHECKING``, and ``import_module`` of a
literal name as well. A package's ``__init__`` counts when a name is taken from it, not when a module below it is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
LAYERS = ("scene_envs", "rewards", "agents")
"""Each may import those before it."""


def module_name(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


FILES = {module_name(file): file for layer in LAYERS for file in sorted((ROOT / layer).rglob("*.py"))}


def resolved(name: str) -> str | None:
    """The module of ours that ``name`` is, or is a name in."""
    while name and name not in FILES:
        name = name.rpartition(".")[0]
    return name or None


def imported_names(tree: ast.AST) -> Iterator[str]:
    """Dotted names that are imported anywhere in a module; relative imports are not used in this project."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"a relative import in line {node.lineno}"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if function == "import_module":
                yield str(node.args[0].value)


@cache
def import_graph() -> dict[str, set[str]]:
    """Which modules of the three packages each module imports."""
    graph = {}
    for name, file in FILES.items():
        found = {resolved(target) for target in imported_names(ast.parse(file.read_text(encoding="utf-8")))}
        graph[name] = {target for target in found if target is not None and target != name}
    return graph
