"""Import directions of the three packages: no circles, no upward imports, no test helpers in production code."""

from __future__ import annotations

import re

import pytest

from tests.helpers.import_graph import LAYERS, ROOT, import_graph


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
