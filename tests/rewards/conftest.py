"""An installed reward package, and scenes whose scores are known."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from scene_envs import SceneBatch

PLUGIN = Path(__file__).parents[1] / "plugin_package"


@pytest.fixture(scope="session")
def plugin_site(tmp_path_factory) -> Path:
    """A folder into which pip has installed the plug-in package, without network."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base  # one for all workers
    copy, site = base / "plugin", base / "plugin_site"
    with FileLock(f"{site}.lock"):
        if not site.exists():
            shutil.copytree(PLUGIN, copy)  # pip leaves build products beside the source
            options = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--disable-pip-version-check"]
            command = [sys.executable, "-m", "pip", "install", *options, "--target", str(site), str(copy)]
            subprocess.run(command, check=True, capture_output=True, text=True)
    return site


@pytest.fixture
def plugin(plugin_site, monkeypatch):
    """The plug-in package on the path of this process, for one test."""
    monkeypatch.syspath_prepend(str(plugin_site))
    yield
    for name in [name for name in sys.modules if name.startswith("open_space_rewards")]:
        del sys.modules[name]


@pytest.fixture
def cups() -> SceneBatch:
    """Two scenes: teacups at 0.1, 0.2 and 0.3 m from the middle; then one at 0.4 m."""
    batch = SceneBatch.empty("dimsum_table", 2, slots=6)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    cup = batch.scene_type.assets.index("teacup")
    translations[0, 1:4, 0] = torch.tensor([0.1, 0.2, 0.3])
    categories[0, 1:4] = cup
    translations[1, 1, 1] = 0.4
    categories[1, 1] = cup
    rotations = torch.eye(3).expand(2, 6, 3, 3)
    return SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)
