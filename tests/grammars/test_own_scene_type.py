"""Scene types of other installed packages: use by name, as with a built-in type."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from agents.cli import main
from agents.pretraining.initial_prior import build_prior
from agents.pretraining.settings import PretrainConfig
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import RewardContext, check_reward, resolve_reward
from scene_envs import SceneBatch, get_scene_type, list_scene_types
from scene_envs import registry as plugins
from scene_envs.datasets import SceneDataset, generate, judge_scenes, parse_prompt, scene_facts
from scene_envs.errors import UnknownNameError
from scene_envs.export import export
from scene_envs.grammars import get_grammar, list_grammars
from scene_envs.physics import PhysicsPool, feasibility, make_ready
from scene_envs.render import observe, render, write_viewer
from tests.helpers.outside_package import installed
from tests.helpers.trap import trapped

DOCS = Path(__file__).parents[2] / "docs" / "grammars.md"
pytestmark = pytest.mark.slow
NAME = "tea_table"


@pytest.fixture(scope="module", autouse=True)
def tea_house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The package of examples/extending on the path of this process; forgotten afterwards."""
    with installed(tmp_path_factory.mktemp("site"), missing="tea_house.not_there") as site:
        yield site


@pytest.fixture(scope="module", autouse=True)
def _ranges_of_few_objects() -> Iterator[None]:
    """Ranges come from few objects, as those of built-in grammars in ``tests/conftest.py``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scene_envs.datasets.generation._OBJECTS", 200)
        patch.setattr("scene_envs.datasets.generation._STEP", 32)
        yield


@pytest.fixture(scope="module")
def folder(tea_house: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of four scenes, made by a new interpreter that finds the package, and nothing in the current folder."""
    output = tmp_path_factory.mktemp("data") / NAME
    with pytest.MonkeyPatch.context() as patch, trapped(tmp_path_factory.mktemp("current")):
        patch.setattr("scene_envs.workers.subprocess", subprocess)
        report = generate(NAME, 4, output, seed=3, workers=1, shard_size=2, progress=False)
    assert report.scenes == 4
    return output


@pytest.fixture(scope="module")
def batch(folder: Path) -> SceneBatch:
    return SceneDataset.load(folder).batch()


@pytest.fixture(scope="module")
def prior() -> ScenePrior:
    return tiny_prior(NAME)


def test_it_is_listed_and_found_without_an_import_of_its_package() -> None:
    assert NAME in list_scene_types()
    assert NAME in list_grammars()
    assert get_scene_type(NAME).slots == 13
    with pytest.raises(UnknownNameError, match=f"did you mean '{NAME}'"):
        get_scene_type("tea_tabel")
    with pytest.raises(UnknownNameError, match=f"did you mean '{NAME}'"):
        get_grammar("tea_tabel")


def test_a_module_of_the_package_that_is_missing_is_logged_and_stops_nothing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    plugins.load_plugins.cache_clear()
    assert NAME in list_scene_types()
    assert "tea_house.not_there" in caplog.text


def test_the_grammar_does_as_it_says() -> None:
    scenes = get_grammar(NAME).sample(np.random.default_rng(0), 24)
    for names in scenes.names():
        assert names[0] == "cafe_table"
        assert names.count("teapot") == 1
        assert 2 <= names.count("teacup") <= 6
        assert ("shared_plate" in names) != ("fruit_bowl" in names)
        assert 1 <= names.count("bread_slice" if "shared_plate" in names else "apple_gala") <= 4
    assert {"shared_plate", "fruit_bowl"} <= {name for names in scenes.names() for name in names}
    assert set(judge_scenes(scenes)) == {""}


def test_the_command_line_makes_the_same_dataset(folder: Path, tmp_path: Path) -> None:
    words = ["generate", f"scene={NAME}", "count=4", "seed=3", "shard_size=2", "workers=0", f"output={tmp_path}"]
    assert main(words) == 0
    here, there = SceneDataset.load(tmp_path), SceneDataset.load(folder)
    assert here.scene_type == there.scene_type == get_scene_type(NAME)
    assert torch.equal(here.tensor, there.tensor)
    assert here.prompts == there.prompts


def test_prompts_are_true_of_the_scenes(folder: Path) -> None:
    dataset = SceneDataset.load(folder)
    for facts, prompt in zip(scene_facts(dataset.batch()), dataset.prompts, strict=True):
        assert parse_prompt(prompt, NAME).holds(facts), prompt


def test_physics_in_a_pool_is_physics_here(batch: SceneBatch) -> None:
    here = feasibility(batch[:2])
    with PhysicsPool(workers=1) as pool:
        there = feasibility(batch[:2], pool=pool)
    assert torch.equal(here.depth, there.depth)
    assert torch.equal(here.displacement, there.displacement)
    assert bool(make_ready(batch[:1]).valid.all())


def test_pictures_have_its_colours_and_the_viewer_its_name(batch: SceneBatch, tmp_path: Path) -> None:
    library = batch.scene_type.library
    image = observe(batch[:1], modes=["semantic"])[0]["semantic"][0]
    seen = {tuple(color) for color in image.reshape(-1, 3).tolist()}
    assert {library["cafe_table"].color, library["teapot"].color} <= seen
    assert seen <= {asset.color for asset in library} | {(255, 255, 255)}
    assert render(batch[:1], width=64, height=48).shape == (1, 48, 64, 3)
    assert "tea table" in write_viewer(batch[:1], tmp_path / "page.html").read_text().lower()


def test_environments_play_it(prior: ScenePrior, tmp_path: Path) -> None:
    env = gym.make("SceneEnvs/Denoising-v0", scene=NAME, prior=prior, reward="object_count", num_steps=3)
    observation, _ = env.reset(seed=0)
    assert observation["scene"].shape == (13, get_scene_type(NAME).features)
    for _ in range(3):
        _, reward, terminated, _, _ = env.step(env.action_space.sample())
    assert terminated
    assert reward >= 0
    saved = prior.save(tmp_path)
    search = gym.make("SceneEnvs/Search-v0", scene=NAME, prior=str(saved), objective="object_count", num_steps=2)
    search.reset(seed=0)
    assert len(search.step(0)) == 5


def test_a_prior_of_it_is_built_trained_saved_and_sampled(folder: Path, tmp_path: Path) -> None:
    dataset = SceneDataset.load(folder)
    config = PretrainConfig(scene=NAME, network={"hidden": 32, "depth": 1, "heads": 2})
    prior = build_prior(config, dataset.tensor, dataset.normalizer)
    loss = prior.pretraining_loss(dataset.normalizer.normalize(dataset.tensor), torch.Generator().manual_seed(0))
    loss.backward()
    assert bool(loss.isfinite())
    scenes = ScenePrior.load(prior.save(tmp_path)).sample(2, num_steps=2, seed=0)
    assert scenes.scene_type == get_scene_type(NAME)
    assert [names[0] for names in scenes.names()] == ["cafe_table"] * 2


def test_rewards_score_it(batch: SceneBatch) -> None:
    counts = resolve_reward("object_count")(batch, RewardContext()).value
    assert torch.equal(counts, batch.counts.to(counts))
    assert check_reward("object_count", scene_type=NAME)


def test_it_is_exported(batch: SceneBatch, tmp_path: Path) -> None:
    report = export(batch[:1], tmp_path, ["sdf", "npz"])
    assert set(report.assets) == set(batch.names()[0]) - {""}
    assert "cafe_table" in report.scenes[0]["sdf"].read_text()


def test_the_documented_example_is_this_package() -> None:
    source = Path(import_module("tea_house.tea_table").__file__ or "").read_text()
    assert source in DOCS.read_text()
