"""The one-file example runs against the public environment and agrees with the package."""

from __future__ import annotations

import csv
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agents.diffusion.reverse_steps import gaussian_log_prob
from agents.post_training import compute_advantages
from agents.priors.base import ScenePrior
from agents.priors.testing import tiny_prior


@pytest.fixture(scope="module")
def example() -> ModuleType:
    path = Path(__file__).parents[2] / "examples" / "ddpo_sf.py"
    spec = importlib.util.spec_from_file_location("ddpo_sf_example", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_it_trains_and_saves_a_prior(example: ModuleType, tmp_path: Path) -> None:
    tiny_prior().save(tmp_path / "base")
    settings = {"iterations": 2, "batch_size": 4, "num_steps": 5, "gradient_steps": 2, "real_scenes": 32}
    example.main(example.Args(prior=str(tmp_path / "base"), output=str(tmp_path / "run"), **settings))
    with (tmp_path / "run" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2
    assert float(rows[0]["log_ratio"]) == 0.0
    assert float(rows[0]["policy_gradient_norm"]) > 0
    assert len(ScenePrior.load(tmp_path / "run").sample(1, num_steps=2)) == 1


def test_its_pieces_agree_with_the_package(example: ModuleType) -> None:
    generator = torch.Generator().manual_seed(0)
    reward, valid = torch.randn(7, generator=generator), torch.tensor([1, 1, 0, 1, 1, 1, 0]).bool()
    torch.testing.assert_close(example.advantages(reward, valid, 5.0), compute_advantages(reward, valid))
    x, mean = torch.randn(2, 3, 4, generator=generator), torch.randn(2, 3, 4, generator=generator)
    std = torch.rand(3, 4, generator=generator) + 0.1
    std[0] = 0.0
    torch.testing.assert_close(example.log_prob(x, mean, std), gaussian_log_prob(x, mean, std).sum(dim=1) / 8)
