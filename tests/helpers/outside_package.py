"""The package of examples/extending, laid out as pip would in a folder outside the repository."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest
import tomllib

from agents.networks import list_networks
from agents.planning import list_planners
from agents.post_training import list_algorithms
from scene_envs import list_scene_types
from scene_envs import registry as plugins

EXAMPLE = Path(__file__).parents[2] / "examples" / "extending"


def lay_out(site: Path, *, missing: str = "") -> None:
    """Copy the package into ``site``, its entry points beside it.

    Args:
        site: folder that goes on the path.
        missing: a module that is not there, offered as one more scene type; empty for none.
    """
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    module = project["name"].replace("-", "_")
    shutil.copytree(EXAMPLE / module, site / module, ignore=shutil.ignore_patterns("__pycache__"))
    about = site / f"{module}-{project['version']}.dist-info"
    about.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (about / "METADATA").write_text(head)
    groups = {group: dict(entries) for group, entries in project["entry-points"].items()}
    if missing:
        groups["scene_envs.scene_types"]["missing_module"] = missing
    lines = [f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in entries.items()) for group, entries in groups.items()]
    (about / "entry_points.txt").write_text("\n\n".join(lines) + "\n")


@contextmanager
def installed(site: Path, *, missing: str = "") -> Iterator[Path]:
    """The package on the path of this process and of those that it starts; forgotten afterwards."""
    lay_out(site, missing=missing)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.syspath_prepend(str(site))
        plugins.load_plugins.cache_clear()
        for listed in (list_algorithms, list_planners, list_scene_types, partial(list_networks, "mixed")):
            listed()  # registers what is installed, once, before the state that every test goes back to
        yield site
    plugins.load_plugins.cache_clear()
    for name in [name for name in sys.modules if name.partition(".")[0] == "tea_house"]:
        del sys.modules[name]
