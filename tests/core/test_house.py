"""Rules of the house: imports point one way, a class is whole in one file, and a short file has a reason."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.helpers.import_graph import FILES, LAYERS, ROOT, import_graph


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


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": {"e"}, "e": set[str]()}
    assert circles(graph) == [{"a", "b", "c"}]


def test_no_circles_between_modules() -> None:
    assert [sorted(circle) for circle in circles(import_graph())] == []


def test_no_circles_between_rooms_of_agents() -> None:
    rooms: dict[str, set[str]] = {}
    for name, targets in import_graph().items():
        if name.count(".") and name.startswith("agents."):
            room = name.split(".")[1]
            others = {target.split(".")[1] for target in targets if target.startswith("agents.")}
            rooms.setdefault(room, set()).update(others - {room})
    assert circles(rooms) == []


@pytest.mark.parametrize("package", LAYERS)
def test_no_module_imports_upwards(package: str) -> None:
    upwards = [
        f"{name} -> {target}"
        for name, targets in import_graph().items()
        for target in sorted(targets)
        if name.split(".")[0] == package and layer(target) > layer(name)
    ]
    assert upwards == []


@pytest.mark.parametrize(("package", "above"), [("scene_envs", "agents|rewards"), ("rewards", "agents")])
def test_no_module_names_a_package_above_its_own(package: str, above: str) -> None:
    """Not in code, and not in docstrings."""
    named = re.compile(rf"\b(?:{above})\.[a-z_]\w*")
    found = [(file.name, named.findall(file.read_text())) for file in (ROOT / package).rglob("*.py")]
    assert [(name, words) for name, words in found if words] == []


def test_production_code_imports_no_testing_module() -> None:
    testing = {name for name in import_graph() if name.split(".")[-1] == "testing"}
    assert [
        f"{name} -> {t}" for name, targets in import_graph().items() for t in targets & testing if name not in testing
    ] == []


def test_nothing_is_at_the_top_of_agents_but_its_surface() -> None:
    assert [path.name for path in (ROOT / "agents").glob("*.py")] == ["__init__.py"]


def test_what_tests_share_is_in_helpers() -> None:
    shared = re.compile(r"^\s*(?:from|import) tests\.(?!helpers\b)", re.MULTILINE)
    assert [file.name for file in (ROOT / "tests").rglob("*.py") if shared.search(file.read_text())] == []


def test_every_subpackage_has_a_folder_of_tests() -> None:
    packages = [path.parent.name for top in ("scene_envs", "agents") for path in (ROOT / top).glob("*/__init__.py")]
    assert [name for name in packages if not list((ROOT / "tests" / name).glob("test_*.py"))] == []


SHORT = 60
"""Lines below which a file with a single importer belongs to its importer."""
LISTED: dict[str, str] = {}
"""Short files with one importer that stay, and why."""


def lines_of(file: Path) -> int:
    return file.read_text(encoding="utf-8").count("\n")


def importers_of(name: str) -> set[str]:
    """Modules that import a module, but for the surface of its own package, which only passes names on."""
    package = name.rpartition(".")[0]
    return {other for other, targets in import_graph().items() if name in targets and other != package}


@cache
def bases() -> dict[tuple[str, str], set[tuple[str, str]]]:
    """Classes of ours by module and name, and those of ours that they extend."""
    found = {}
    for module, file in FILES.items():
        tree = ast.parse(file.read_text(encoding="utf-8"))
        origin = {
            alias.asname or alias.name: (node.module or "", alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                names = [getattr(getattr(base, "value", base), "id", "") for base in node.bases]
                names += [getattr(base, "id", "") for base in node.bases]
                found[module, node.name] = {origin.get(name, (module, name)) for name in names if name}
    return found


def test_no_class_has_its_only_subclass_in_another_file_of_its_folder() -> None:
    subclasses: dict[tuple[str, str], set[tuple[str, str]]] = {}
    for child, parents in bases().items():
        for parent in parents & bases().keys():
            subclasses.setdefault(parent, set()).add(child)
    split = [
        f"{'.'.join(parent)} <- {'.'.join(child)}"
        for parent, (child, *others) in subclasses.items()
        if not others and parent[0] != child[0] and parent[0].rpartition(".")[0] == child[0].rpartition(".")[0]
    ]
    assert split == []


def test_a_short_file_with_one_importer_has_a_listed_reason() -> None:
    short = {
        name
        for name, file in FILES.items()
        if file.name != "__init__.py" and lines_of(file) < SHORT and len(importers_of(name)) == 1
    }
    assert short == LISTED.keys()


def test_settings_import_no_torch() -> None:
    settings = [name for name in FILES if name.rpartition(".")[2] == "settings" or ".configuration" in name]
    assert len(settings) > 3
    code = (
        "import sys; from importlib import import_module\n"
        f"for name in {settings}: import_module(name)\n"
        "print('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_the_house_keeps_its_size() -> None:
    """At most 210 files and 47,000 lines, 220 lines a file at least on average."""
    count, lines = len(FILES), sum(map(lines_of, FILES.values()))
    assert count <= 210
    assert lines <= 47_000
    assert lines / count >= 220
