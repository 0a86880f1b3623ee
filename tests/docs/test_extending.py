"""Parts of another package: as long as the page says, shown there as they are, and doing what they say."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from agents import PostTrainConfig, PretrainConfig
from agents.cli import main
from agents.cli.keys import compose
from agents.planning.ledger import planner_settings
from agents.post_training import DDPOSFLoss, DenoisingPolicy, compute_advantages
from agents.post_training.rollouts import collect
from agents.post_training.settings import algorithm_settings, make_algorithm
from agents.priors.testing import tiny_prior
from rewards import RewardContext, check_reward, make_reward
from scene_envs import SceneBatch, get_scene_type
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.masks import resolve_mask
from tests.helpers.outside_package import EXAMPLE, installed

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text(encoding="utf-8")
MOST = {"reward": 15, "mask": 15, "planner": 40, "algorithm": 60, "tea_table": 80, "deep_sets": 120}
"""Lines that each may have."""


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with installed(tmp_path_factory.mktemp("site")):
        yield


@pytest.fixture(scope="module")
def prior(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tiny_prior(slots=6).save(tmp_path_factory.mktemp("prior")))


@pytest.mark.parametrize("name", MOST)
def test_the_page_shows_the_file_and_counts_its_lines(name: str) -> None:
    code = (EXAMPLE / "tea_house" / f"{name}.py").read_text(encoding="utf-8")
    assert f"```python\n{code}```" in PAGE
    lines = len([line for line in code.splitlines() if line.strip()])
    row = re.search(rf"\[`{name}.py`\]\([^)]*\) \| (\d+) \|", PAGE)
    assert row
    assert int(row[1]) == lines <= MOST[name]


def test_the_page_shows_the_project_file() -> None:
    assert f"```toml\n{(EXAMPLE / 'pyproject.toml').read_text(encoding='utf-8')}```" in PAGE


def scene(*heights: float, radius: float = 0.1) -> SceneBatch:
    """The table, cups at these heights at ``radius`` from the middle, and two empty slots."""
    batch = SceneBatch.empty("dimsum_table", 1, slots=3 + len(heights))
    translations, categories = batch.translations.clone(), batch.categories.clone()
    for slot, height in enumerate(heights, start=1):
        translations[0, slot] = torch.tensor([radius, 0.0, height])
        categories[0, slot] = get_scene_type("dimsum_table").assets.index("teacup")
    return SceneBatch.from_parts(translations, batch.rotations, categories, batch.scene_type)


def test_the_reward_is_the_height_of_the_tower_in_any_package() -> None:
    assert check_reward("tower")
    value = make_reward("tower", scale=2.0)(scene(0.1, 0.45, 0.2), RewardContext()).value
    assert value.tolist() == pytest.approx([0.7])
    assert make_reward("tower")(scene(), RewardContext()).value.tolist() == [0.0]


def test_the_mask_takes_the_rim_and_two_empty_slots() -> None:
    rng = np.random.default_rng(0)
    near, far = (resolve_mask("outer")(scene(0.0, 0.0, radius=r), None, rng)[0:] for r in (0.1, 0.4))  # type: ignore[arg-type]
    assert near.tolist() == [False, False, False, True, True]
    assert far.tolist() == [False, True, True, True, True]


@dataclass(frozen=True)
class Number:
    """A state of a tree of digits; its objective is 0.123 for the path 1, 2, 3."""

    digits: tuple[int, ...] = ()
    valid: bool = True


class Digits:
    """A tree of three digits below 4, as a search environment; the digit 3 leads to states that have no score."""

    def clone_state(self) -> Number:
        return Number()

    def legal_actions(self, state: Number) -> range:
        return range(4) if len(state.digits) < 3 else range(0)

    def expand_batch(self, pairs: list[tuple[Number, int]]) -> list[Number]:
        return [Number((*state.digits, action), action != 3) for state, action in pairs]

    def evaluate(self, state: Number) -> float:
        return sum(digit * 0.1**place for place, digit in enumerate(state.digits, start=1))


def test_the_planner_finds_the_best_leaf_of_a_tree_within_its_budget() -> None:
    settings = planner_settings("levels")
    result = settings(width=2).make(4).plan(Digits(), 100)
    assert result.best_path == (2, 2, 2)
    assert result.best_value == pytest.approx(0.222)
    assert len(result.values) == 4 + 8 + 8
    assert np.isnan(result.values).sum() == 1 + 2 + 2
    assert len(settings(width=2).make(4).plan(Digits(), 7).values) == 7


def test_the_loss_starts_as_the_policy_gradient_and_holds_the_policy_back() -> None:
    prior = tiny_prior(slots=6)
    policy = DenoisingPolicy(prior, 4)
    rollout = collect(DenoisingTorchRLEnv(3, prior=prior, reward="object_count", num_steps=4, slots=6), policy, seed=0)
    advantage = compute_advantages(torch.tensor([1.0, 2.0, 4.0]), torch.ones(3, dtype=torch.bool))
    ours = make_algorithm(algorithm_settings("proximal")(min_std=1e-3), policy, policy.stds(6)).loss
    plain = DDPOSFLoss(policy, step_weights=ours.step_weights)
    parameters = list(prior.denoiser.network.parameters())
    transitions = rollout[:, 1].set("advantage", advantage)
    found, expected = (
        torch.autograd.grad(loss(transitions)["loss_objective"], parameters, allow_unused=True)
        for loss in (ours, plain)
    )
    for mine, reference in zip(found, expected, strict=True):
        assert (mine is None) == (reference is None)
        if mine is not None:
            torch.testing.assert_close(mine, reference, rtol=1e-3, atol=1e-7)
    transitions["slot_log_prob"] = transitions["slot_log_prob"] + 1.0  # as if the policy had moved
    transitions["advantage"] = torch.zeros(3)
    shift = 6 / policy.random_entries(6)
    expected_loss = float(ours.step_weights[1]) * ours.penalty * shift**2
    assert float(ours(transitions)["loss_objective"].detach()) == pytest.approx(expected_loss, rel=1e-4)


OPTIONS = {
    "algorithm/proximal": "name: proximal\npenalty: 0.5\n",
    "reward/tower": "name: tower\nscale: 2.0\n",
    "network/deep_sets": "name: deep_sets\nhidden: 16\ndepth: 3\n",
    "mask/outer": "name: outer\n",
    "planner/levels": "name: levels\nwidth: 1\n",
    "experiment/short": """# @package _global_
defaults:
  - override /algorithm: proximal
  - override /reward: tower
iterations: 2
batch_size: 3
num_steps: 3
regularisation: {batch_size: 2, bank_size: 8}
guard: {scenes: 2}
logger: {report_scenes: 0}
progress: none
""",
}
"""A folder of values for the names of the package, as a user's ``--config-dir``."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    configs = tmp_path_factory.mktemp("configs")
    for name, text in OPTIONS.items():
        (configs / name).parent.mkdir(exist_ok=True)
        (configs / f"{name}.yaml").write_text(text, encoding="utf-8")
    return str(configs)


@pytest.mark.slow
def test_search_takes_the_reward_the_mask_and_the_planner_by_name(prior: str, folder: str, tmp_path: Path) -> None:
    words = ["objective=tower", "objective_scale=0.5", "mask=outer", "planner=levels", "slots=6"]
    small = ["budget=3", "branching=2", "num_steps=1", f"output={tmp_path}", "--config-dir", folder]
    assert main(["search", f"prior={prior}", *words, *small]) == 0
    settings = yaml.safe_load((tmp_path / "config.yaml").read_text())
    assert settings["planner"] == {"name": "levels", "width": 1}
    assert settings["mask"] == "outer"


@pytest.mark.slow
@pytest.mark.usefixtures("blank_curves")
def test_an_experiment_with_the_algorithm_and_the_reward_runs_twice_alike(
    prior: str, folder: str, tmp_path: Path
) -> None:
    """The ``config.yaml`` of the run starts it again, without the folder that its values came from."""
    words = ["post-train", "+experiment=short", f"prior={prior}", "slots=6", f"output={tmp_path / 'run'}"]
    assert main([*words, "algorithm.gradient_steps=2", "--config-dir", folder]) == 0
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert {**config["algorithm"], "name": "proximal", "penalty": 0.5, "gradient_steps": 2} == config["algorithm"]
    assert config["reward"] == {"name": "tower", "scale": 2.0}
    assert main(["post-train", "--config", str(tmp_path / "run" / "config.yaml"), f"output={tmp_path / 'again'}"]) == 0
    first, second = (json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("run", "again"))
    assert first["reward"] == second["reward"]


def test_the_network_has_its_keys_on_the_command_line_and_in_python(folder: str, tmp_path: Path) -> None:
    """The scene type and the network have tests of their own, in the folders of grammars and of networks."""
    words = ["network=deep_sets", "network.depth=2"]
    composed = compose("pretrain", PretrainConfig, words, config_dir=folder)
    assert (composed.network.name, composed.network.hidden, composed.network.depth) == ("deep_sets", 16, 2)
    assert PretrainConfig(network="deep_sets").network.name == "deep_sets"  # without its YAML
    assert PostTrainConfig(algorithm="proximal").algorithm.penalty == 1.0  # type: ignore[attr-defined]
    output = ["--config-dir", folder, f"output={tmp_path}"]
    assert main(["pretrain", "network=deep_sets", "process=continuous", *output]) == 2


def test_help_lists_options_of_the_folder(folder: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["post-train", "--help", "--config-dir", folder]) == 0
    assert re.search(r"algorithm=ddpo_sf \(or .*\bproximal\b.*\):", capsys.readouterr().out)
    assert main(["post-train", "algorithm=proximal", "--help", "--config-dir", folder]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"algorithm=proximal \(or .*\bddpo_sf\b.*\):", shown)
    assert "algorithm.penalty=0.5" in shown
    assert "coefficient of the squared log-ratio" in shown
