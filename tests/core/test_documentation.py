"""Agreement of documentation and code: API pages with public names, the drawing with imports, help with targets."""

from __future__ import annotations

import importlib.util
import re
import subprocess
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.import_graph import import_graph

ROOT = Path(__file__).parents[2]
API = sorted(path.stem for path in (ROOT / "docs" / "api").glob("*.md") if path.stem != "README")
PACKAGES = sorted(
    ".".join(file.parent.relative_to(ROOT).parts)
    for top in ("scene_envs", "rewards", "agents")
    for file in [ROOT / top / "__init__.py", *(ROOT / top).glob("*/__init__.py")]
)


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


ARCHITECTURE = load(ROOT / "docs" / "site_files" / "architecture.py")
ROW = {room: row for row, rooms in enumerate(ARCHITECTURE.ROWS) for room in rooms}


CORE = {f"scene_envs.{name}" for name in ("normalizer", "rotations", "scene", "supports")}
"""Single files that the box of SceneBatch stands for."""


def room_of(module: str) -> str | None:
    """The box that a module is drawn in, None for other single files at the top of ``scene_envs`` and of ``agents``."""
    if module in CORE:
        return "scene_envs.scene"
    return next((room for room in ROW if module == room or module.startswith(f"{room}.")), None)


def room_imports() -> set[tuple[str, str]]:
    return {
        (here, there)
        for module, targets in import_graph().items()
        for target in targets
        if (here := room_of(module)) and (there := room_of(target)) and here != there
    }


def test_every_package_with_public_names_has_an_api_page() -> None:
    public = [name for name in [*PACKAGES, "scene_envs.scene_types"] if hasattr(import_module(name), "__all__")]
    assert sorted({*public} - {"agents.cli"}) == API


@pytest.mark.parametrize("package", API)
def test_an_api_page_describes_every_public_name(package: str) -> None:
    page = (ROOT / "docs" / "api" / f"{package}.md").read_text(encoding="utf-8")
    described = {path.rpartition(".")[2] for path in re.findall(r"^::: (\S+)$", page, re.MULTILINE)}
    linked = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert described | linked == set(import_module(package).__all__) - {"__version__"}
    for path in re.findall(r"^::: (\S+)$", page, re.MULTILINE):
        module, _, name = path.rpartition(".")
        assert hasattr(import_module(module), name), path


def test_every_room_is_drawn_below_what_it_imports() -> None:
    assert {name for name in PACKAGES if name.count(".")} <= {*ROW, "scene_envs.scene"}
    assert [f"{here} -> {there}" for here, there in sorted(room_imports()) if ROW[here] <= ROW[there]] == []


def test_arrows_of_the_drawing_are_imports() -> None:
    steps = [(later, earlier) for earlier, later in pairwise(ARCHITECTURE.WAY)]
    assert {*steps, *ARCHITECTURE.CALLS} <= room_imports()


def test_the_committed_drawing_is_that_of_the_script() -> None:
    assert ARCHITECTURE.FILE.read_text(encoding="utf-8") == ARCHITECTURE.drawing()


def headings_of(page: Path) -> set[str]:
    """Anchors of a page, as code hosts and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    anchors: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "").strip().lower()
        anchor = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        anchors.add(anchor if anchor not in anchors else f"{anchor}-1")
    return anchors


def test_every_link_between_pages_leads_to_a_heading() -> None:
    pages = [
        path for top in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "agents/**/README.md") for path in ROOT.glob(top)
    ]
    assert len(pages) > 50
    broken = []
    for page in pages:
        prose = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)\)", prose):
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            if not target.exists() or (anchor and target.suffix == ".md" and anchor not in headings_of(target)):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert broken == []


def test_make_help_lists_every_target() -> None:
    listed = set(re.findall(r"^make ([\w-]+)  ", subprocess.run(
        ["make", "--no-print-directory", "help"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout, re.MULTILINE))  # fmt: skip
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony
    assert listed == set(phony.group(1).split())
