"""Components of another package: one file and one YAML each, chosen on the command line."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from agents import PostTrainConfig, PretrainConfig
from agents.cli import main
from agents.networks import registry as networks
from agents.planning import registry as planners
from agents.post_training import algorithms
from agents.priors.base import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import registry as rewards
from scene_envs.envs import masks
from scene_envs.plugins import load_plugins

PACKAGE = Path(__file__).parents[1] / "plugin_components"
_REGISTRIES = (
    *((rewards, "_registry"), (networks, "_ENTRIES"), (algorithms, "_ENTRIES")),
    *((planners, "_PLANNERS"), (masks, "_MASKS")),
)
DIRECTORY = ["--config-dir", str(PACKAGE / "configs")]


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> object:
    """The package as pip would lay it out, on the path of this process for one test."""
    site = tmp_path / "site"
    shutil.copytree(PACKAGE / "scene_parts", site / "scene_parts")
    about = site / "scene_parts-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: scene-parts\nVersion: 1.0\n")
    shutil.copy(PACKAGE / "entry_points.txt", about)
    monkeypatch.syspath_prepend(str(site))
    for module, name in _REGISTRIES:
        monkeypatch.setattr(module, name, dict(getattr(module, name)))
    load_plugins.cache_clear()
    yield
    load_plugins.cache_clear()
    for name in [name for name in sys.modules if name.startswith("scene_parts")]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tiny_prior(slots=6).save(tmp_path_factory.mktemp("prior")))


@pytest.mark.usefixtures("package")
def test_an_algorithm_and_a_reward_in_an_experiment(prior: str, tmp_path: Path) -> None:
    words = ["post-train", "+experiment=short", f"prior={prior}", "slots=10", f"output={tmp_path / 'run'}"]
    assert main([*words, "algorithm.gradient_steps=2", *DIRECTORY]) == 0
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["algorithm"]["name"] == "signs"
    assert (config["algorithm"]["size"], config["algorithm"]["gradient_steps"]) == (0.5, 2)
    assert config["reward"] == {"name": "spread_out", "scale": 2.0}
    again = ["post-train", "--config", str(tmp_path / "run" / "config.yaml"), f"output={tmp_path / 'again'}"]
    assert main(again) == 0
    first, second = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("run", "again"))
    assert first["reward"] == second["reward"]


@pytest.mark.usefixtures("package")
def test_a_network(tmp_path: Path) -> None:
    words = ["pretrain", "network=thin", "data=grammar", "iterations=1", "batch_size=2"]
    words += ["process.empty_slots=attended", f"output={tmp_path / 'run'}", *DIRECTORY]
    assert main(words) == 0
    network = ScenePrior.load(tmp_path / "run").denoiser.network
    assert type(network).__name__ == "Thin"
    assert main([*words, "process=continuous", f"output={tmp_path / 'other'}"]) == 2
    assert PretrainConfig(network="thin").network.name == "thin"  # without its YAML, with the keys of the default
    assert PostTrainConfig(algorithm="signs").algorithm.size == 1.0  # type: ignore[attr-defined]


@pytest.mark.usefixtures("package")
def test_a_mask_and_a_planner(prior: str, tmp_path: Path) -> None:
    words = ["search", f"prior={prior}", "objective=object_count", "planner=wide", "mask=everything", "slots=6"]
    small = ["budget=3", "branching=3", "num_steps=1", f"output={tmp_path / 'run'}"]
    assert main([*words, *small, *DIRECTORY]) == 0
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["planner"] == {"name": "wide", "batch": 3}
    assert config["mask"] == "everything"


@pytest.mark.usefixtures("package")
def test_help_lists_options_of_the_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["post-train", "--help", *DIRECTORY]) == 0
    assert "algorithm=ddpo_sf (or awm, ddpo_is, nft, reward_weighted, signs):" in capsys.readouterr().out
    assert main(["post-train", "algorithm=signs", "--help", *DIRECTORY]) == 0
    shown = capsys.readouterr().out
    assert "algorithm=signs (or awm, ddpo_is, ddpo_sf, nft, reward_weighted):" in shown
    assert "algorithm.size=0.5" in shown
    assert "of every advantage." in shown
