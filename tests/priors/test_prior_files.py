"""Half-precision files: half the size, weights within a rounding, samples that stay close."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from agents.priors.prior import ScenePrior
from safetensors import safe_open

from agents.priors.files import to_precision
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError, UnknownNameError

HALF_ROUNDING = 2.0**-11
SMALLEST_NORMAL = 2.0**-14


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_weights_come_back_within_a_rounding_in_float32(tmp_path: Path, process: str) -> None:
    prior = tiny_prior(process=process)
    whole, half = prior.save(tmp_path / "whole"), prior.save(tmp_path / "half", precision="float16")
    again = ScenePrior.load(half)
    for name, weight in prior.weights().items():
        loaded = again.weights()[name]
        assert loaded.dtype == torch.float32
        bound = HALF_ROUNDING * weight.abs().clamp(min=SMALLEST_NORMAL)
        assert bool(((loaded - weight).abs() <= bound).all()), name
    sizes = [(folder / "model.safetensors").stat().st_size for folder in (whole, half)]
    assert sizes[1] < 0.6 * sizes[0]
    assert json.loads((whole / "config.json").read_text()) == json.loads((half / "config.json").read_text())


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_samples_stay_close(tmp_path: Path, process: str) -> None:
    prior = tiny_prior(process=process)
    again = ScenePrior.load(prior.save(tmp_path, precision="float16"))
    whole, half = (p.sample(4, num_steps=10, seed=0) for p in (prior, again))
    same = whole.categories == half.categories
    assert same.double().mean() > 0.97
    kept = same & ~whole.is_empty
    assert (whole.translations - half.translations)[kept].norm(dim=-1).median() < 2e-3


def test_measured_variances_keep_their_precision(tmp_path: Path) -> None:
    prior = tiny_prior()
    prior.fit_residual(prior.encode(prior.sample(2, num_steps=2)), levels=3)
    prior.residual.variance[0] = 1e-9  # type: ignore[union-attr]
    again = ScenePrior.load(prior.save(tmp_path, precision="float16"))
    assert torch.equal(again.residual.variance, prior.residual.variance)  # type: ignore[union-attr]


def test_the_files_hold_what_was_asked_for(tmp_path: Path) -> None:
    tiny_prior().save(tmp_path, precision="float16")
    with safe_open(tmp_path / "model.safetensors", "pt") as file:
        kinds = {file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
    assert kinds == {"F16"}


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="float16"):
        to_precision({}, "float61")
    with pytest.raises(InvalidInputError, match=r"'bias' reaches 7e\+04.*float32"):
        to_precision({"bias": torch.tensor([7e4])}, "float16")
    counts = torch.tensor([2**30])
    assert to_precision({"steps": counts}, "float16")["steps"] is counts
