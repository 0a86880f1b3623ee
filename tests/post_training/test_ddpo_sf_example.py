"""The one-file example: it trains priors of every kind in a torchrl loop, with the gradient of the package."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agents.post_training import DDPO, DDPOSFSettings, DenoisingPolicy
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError
from tests.helpers.examples import load_example


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("ddpo_sf")


SMALL = {"iterations": 2, "batch_size": 4, "num_steps": 5, "gradient_steps": 2, "real_scenes": 32}
KINDS = {"continuous": {}, "mixed": {"process": "mixed"}, "reads prompts": {"process": "mixed", "text": True}}


def log_of(run: Path) -> list[dict[str, str]]:
    with (run / "log.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_and_saves_a_prior(example: ModuleType, tmp_path: Path, kind: str) -> None:
    base = tiny_prior(**KINDS[kind])
    base.save(tmp_path / "base")
    example.main(example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **SMALL))
    rows = log_of(tmp_path / "run")
    assert len(rows) == 2
    assert float(rows[0]["log_ratio"]) == 0.0
    assert float(rows[0]["policy_gradient_norm"]) > 0
    trained = ScenePrior.load(tmp_path / "run")
    assert trained.process_name == base.process_name
    assert len(trained.sample(1, num_steps=2)) == 1
    before, after = base.weights(), trained.weights()
    assert any(not torch.equal(before[name], after[name]) for name in before)
    words = [name for name in before if name.startswith("text_encoder.")]
    assert all(torch.equal(before[name], after[name]) for name in words)  # what words mean stays


@pytest.mark.slow
def test_the_command_in_its_first_lines_runs(
    example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = next(line for line in example.__doc__.splitlines() if line.startswith("    python examples/ddpo_sf.py"))
    small = {**SMALL, "output": tmp_path / "run"}
    options = [word for name, value in small.items() for word in ("--" + name.replace("_", "-"), str(value))]
    monkeypatch.setattr(sys, "argv", [*command.split()[1:], *options])
    example.main(example.parse_args())
    assert ScenePrior.load(tmp_path / "run").process_name == "mixed"
    assert len(log_of(tmp_path / "run")) == 2


def test_a_chain_without_a_noisy_step_is_refused(example: ModuleType, tmp_path: Path) -> None:
    tiny_prior().save(tmp_path / "base")
    with pytest.raises(InvalidInputError, match="no step is left in the policy gradient: min_std=100"):
        example.main(
            example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **{**SMALL, "min_std": 100.0})
        )


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_its_gradient_is_that_of_the_package(example: ModuleType, process: str) -> None:
    policy = DenoisingPolicy(tiny_prior(process=process), 4)
    algorithm = DDPO(DDPOSFSettings(gradient_steps=2, min_std=0.01), policy, policy.stds(34))
    env = DenoisingTorchRLEnv(3, prior=policy.prior, reward="object_count", num_steps=4)
    env.set_seed(0)
    batch = algorithm.advantage(env.rollout(4, policy))
    example.add_policy_gradient(algorithm.loss, batch, 2, torch.Generator().manual_seed(0))
    ours = [p.grad for p in policy.parameters()]
    policy.zero_grad(set_to_none=True)
    algorithm.accumulate(batch, torch.Generator().manual_seed(0))
    assert example.norm(ours) > 0
    for mine, parameter in zip(ours, policy.parameters(), strict=True):
        torch.testing.assert_close(mine, parameter.grad)
