"""Imports of the three packages point one way: no circles, no upward arrows, no test helpers in production code.

Every import counts: at the top of a module, inside a function and under ``TYPE_CHECKING``, and ``import_module`` of a
literal name as well. A package's ``__init__`` counts when a name is taken from it, not when a module below it is.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

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


def import_graph() -> dict[str, set[str]]:
    """Which modules of the three packages each module imports."""
    graph = {}
    for name, file in FILES.items():
        found = {resolved(target) for target in imported_names(ast.parse(file.read_text(encoding="utf-8")))}
        graph[name] = {target for target in found if target is not None and target != name}
    return graph


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Sets of modules that reach each other: strongly connected components of more than one (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[set[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for target in sorted(graph[name]):
            if target not in index:
                visit(target)
                low[name] = min(low[name], low[target])
            elif target in stack:
                low[name] = min(low[name], index[target])
        if low[name] == index[name]:
            place = stack.index(name)
            component = set(stack[place:])
            del stack[place:]
            if len(component) > 1:
                found.append(component)

    for name in sorted(graph):
        if name not in index:
            visit(name)
    return found


def layer(name: str) -> int:
    return LAYERS.index(name.split(".")[0])


GRAPH = import_graph()


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set[str]()}
    assert circles(graph) == [{"a", "b", "c"}]


def test_no_circles_between_modules() -> None:
    assert [sorted(circle) for circle in circles(GRAPH)] == []


def test_no_circles_between_rooms_of_agents() -> None:
    rooms: dict[str, set[str]] = {}
    for name, targets in GRAPH.items():
        if name.count(".") and name.startswith("agents."):
            room = name.split(".")[1]
            others = {target.split(".")[1] for target in targets if target.startswith("agents.")}
            rooms.setdefault(room, set()).update(others - {room})
    assert circles(rooms) == []


@pytest.mark.parametrize("package", LAYERS)
def test_no_module_imports_upwards(package: str) -> None:
    upwards = [
        f"{name} -> {target}"
        for name, targets in GRAPH.items()
        for target in sorted(targets)
        if name.split(".")[0] == package and layer(target) > layer(name)
    ]
    assert upwards == []


def test_production_code_imports_no_testing_module() -> None:
    testing = {name for name in GRAPH if name.split(".")[-1] == "testing"}
    assert [f"{name} -> {t}" for name, targets in GRAPH.items() for t in targets & testing if name not in testing] == []


def test_nothing_is_at_the_top_of_agents_but_its_surface() -> None:
    assert [path.name for path in (ROOT / "agents").glob("*.py")] == ["__init__.py"]
