"""One export in every format, shared by the tests that read it back."""

from __future__ import annotations

from pathlib import Path

import pytest

from scene_envs.export import PlacedScene, export, place
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import all_scenes


@pytest.fixture(scope="session")
def batch() -> SceneBatch:
    return all_scenes()


@pytest.fixture(scope="session")
def scenes(batch: SceneBatch) -> list[PlacedScene]:
    return place(batch)


@pytest.fixture(scope="session")
def folder(batch: SceneBatch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export, moved after it was written: every path in it must be relative."""
    output = tmp_path_factory.mktemp("export") / "written here"
    export(batch, output)
    return output.rename(output.with_name("read there"))
