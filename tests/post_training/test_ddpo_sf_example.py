"""The one-file example: it trains priors of every kind in the public environment and agrees with the package."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from agents.priors.prior import ScenePrior

from agents.diffusion import GaussianStep
from agents.diffusion.reverse_steps import gaussian_log_prob
from agents.post_training import compute_advantages
from agents.priors.testing import tiny_prior
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
    with pytest.raises(SystemExit, match="no step has a std of --min-std 100"):
        example.main(
            example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **{**SMALL, "min_std": 100.0})
        )


def test_its_advantages_agree_with_the_package(example: ModuleType) -> None:
    reward = torch.randn(7, generator=torch.Generator().manual_seed(0))
    valid = torch.tensor([1, 1, 0, 1, 1, 1, 0]).bool()
    torch.testing.assert_close(example.advantages(reward, valid, 5.0), compute_advantages(reward, valid))


def test_its_log_probabilities_agree_with_the_package(example: ModuleType) -> None:
    generator = torch.Generator().manual_seed(0)
    x, mean = torch.randn(2, 3, 4, generator=generator), torch.randn(2, 3, 4, generator=generator)
    std = torch.rand(3, 4, generator=generator) + 0.1
    std[0] = 0.0
    expected = gaussian_log_prob(x, mean, std).sum(dim=1) / 8
    torch.testing.assert_close(example.log_prob(GaussianStep(mean, std), x), expected)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_its_gradient_is_that_of_the_package(example: ModuleType, process: str) -> None:
    """Their log-probabilities differ by which slots are unmasked together: a constant, without a gradient."""
    prior, generator = tiny_prior(process=process), torch.Generator().manual_seed(0)
    table = prior.step_table(4)
    x = prior.initial(3, 34, generator)
    for step in range(2):
        reverse = prior.transition(x, step, table)
        action = reverse.from_noise(torch.randn(x.shape, generator=generator)).detach()
        ours, theirs = example.log_prob(reverse, action), reverse.log_prob(action).sum(dim=1) / reverse.entries
        weights = list(prior.denoiser.network.parameters())
        advantage = torch.tensor([1.0, -0.5, 0.25])
        gradients = [
            torch.autograd.grad((advantage * value).sum(), weights, retain_graph=True, allow_unused=True)
            for value in (ours, theirs)
        ]
        for mine, reference in zip(*gradients, strict=True):
            assert (mine is None) == (reference is None)
            if mine is not None:
                torch.testing.assert_close(mine, reference, rtol=1e-4, atol=1e-6)
        x = action
