"""Registries of components: what all share, and the packages whose entry points fill them."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from agents.cli import main
from rewards import list_rewards
from scene_envs import get_scene_type, list_scene_types
from scene_envs import registry as plugins
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.registry import PluginError, load_plugin, plugin_entry_points


@pytest.mark.parametrize("value", [{"a": 1}, ["a"], 3, None])
def test_what_is_no_name_is_refused(value: Any) -> None:
    with pytest.raises(InvalidInputError, match=r"give a name; known: .*dimsum_table"):
        get_grammar(value)
    with pytest.raises(InvalidInputError, match="a scene type or its name is needed"):
        get_scene_type(value)


HARMFUL = {
    "leaves": ("import sys; sys.exit(0)", "calls sys.exit"),
    "quits": ("import os; os._exit(0)", "exit"),
    "hangs": (
        "import time\nwhile True:\n    try:\n        time.sleep(1e6)\n    except Exception:\n        pass",
        "longer than",
    ),
    "raises": ("raise ValueError('x' * 10**6)", "ValueError: xxx"),
    "mumbles": (
        "class Odd(Exception):\n    def __str__(self):\n        raise RuntimeError\nraise Odd",
        "cannot be read",
    ),
}
"""Module, its body, and what is told of it."""
GOOD = "def tidy(batch):\n    '''Objects per scene.'''\n    return batch.counts\n"


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Offers modules as entry points of a group, as an installed package does."""
    names: list[str] = []

    def make(group: str, bodies: dict[str, str], functions: dict[str, str] | None = None) -> None:
        for name, body in bodies.items():
            (tmp_path / f"harm_{name}.py").write_text(body)
            names.append(f"harm_{name}")
        about = tmp_path / "harm-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: harm\nVersion: 1.0\n")
        places = {name: f":{function}" for name, function in (functions or {}).items()}
        lines = [f"{name} = harm_{name}{places.get(name, '')}" for name in bodies]
        (about / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines]) + "\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        plugins.load_plugins.cache_clear()

    yield make
    plugins.load_plugins.cache_clear()
    for name in names:
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", HARMFUL)
def test_an_import_that_harms_the_process_becomes_one_sentence(install, monkeypatch, name: str) -> None:
    monkeypatch.setenv("SCENE_ENVS_PLUGIN_SECONDS", "0.3")
    body, words = HARMFUL[name]
    install("scene_envs.rewards", {name: body})
    with pytest.raises(PluginError, match=words) as told:
        load_plugin(plugin_entry_points("scene_envs.rewards")[name])
    assert len(str(told.value)) < 700
    assert "\n" not in str(told.value)


def test_the_others_of_the_group_are_loaded_and_each_failure_is_told(install, monkeypatch, caplog) -> None:
    monkeypatch.setenv("SCENE_ENVS_PLUGIN_SECONDS", "0.3")
    good = (
        "import dataclasses\nfrom scene_envs.scene_types import get_scene_type, register_scene_type\n"
        "register_scene_type(dataclasses.replace(get_scene_type('dimsum_table'), name='a_plugged_table'))\n"
    )
    install("scene_envs.scene_types", {**{name: body for name, (body, _) in HARMFUL.items()}, "works": good})
    with caplog.at_level(logging.WARNING):
        assert "a_plugged_table" in list_scene_types()
    assert len([record for record in caplog.records if "could not be loaded" in record.getMessage()]) == len(HARMFUL)


@pytest.mark.slow
def test_rewards_are_listed_beside_one_that_crashes_or_hangs_the_interpreter(install, capsys) -> None:
    bodies = {
        "tidy": GOOD,
        "segfaults": "import ctypes; ctypes.string_at(0)",
        "holds": "import ctypes; ctypes.PyDLL(None).sleep(1000)",
        "tidier": GOOD.replace("tidy", "tidier"),
    }
    install("scene_envs.rewards", bodies, {"tidy": "tidy", "tidier": "tidier"})
    assert {"tidy", "segfaults", "holds", "tidier"} <= set(list_rewards())
    assert main(["rewards", "reward_limits={timeout: 3}"]) == 0
    printed = capsys.readouterr().out
    assert "segfaults: cannot be used. reward 'segfaults' crashed its process (SIGSEGV)" in printed
    assert "holds: cannot be used. reward 'holds' took longer than reward_limits.timeout=3 s" in printed
    assert "tidy: Objects per scene." in printed
    assert "tidier: Objects per scene." in printed
    assert "object_count: " in printed


def test_a_package_that_is_installed_meanwhile_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "late" not in plugin_entry_points("scene_envs.rewards")
    about = tmp_path / "late-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[scene_envs.rewards]\nlate = late:reward\n")
    assert plugin_entry_points("scene_envs.rewards")["late"].value == "late:reward"
