"""Adapters: updates of a prior, from priors that were trained from it."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import pytest
import torch
from torch import Generator

from agents.cli.commands.sample import SampleConfig
from agents.cli.keys import compose, help_text
from agents.post_training import post_train
from agents.priors import ScenePrior
from agents.priors.card import card_page
from agents.priors.files import PriorFacts
from agents.priors.testing import tiny_prior
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError
from tests.helpers.small_runs import small_config


@pytest.fixture(params=["continuous", "mixed"])
def base(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior(process=request.param)


def _fine_tuned(prior: ScenePrior, seed: int, base: str) -> ScenePrior:
    """A copy with other weights, as of a run from the prior ``base`` that trained all of them."""
    prior = deepcopy(prior)
    generator = Generator().manual_seed(seed)
    prior.load_weights(
        {name: w + 0.05 * torch.randn(w.shape, generator=generator) for name, w in prior.weights().items()}
    )
    prior.card = {"post_training": {"base": base}}
    return prior


def test_updates_add_with_factors_and_any_spelling_of_a_sum(base: ScenePrior, tmp_path: Path) -> None:
    """base + 0.7 (a - base) - 0.2 (b - base), of every weight; a term may come twice, and a run holds its prior."""
    folder = base.save(tmp_path / "base")
    a, b = (_fine_tuned(base, seed, "base") for seed in (1, 2))
    paths = [str(a.save(tmp_path / "run" / "prior").parent), str(b.save(tmp_path / "b"))]
    weights = [prior.weights() for prior in (base, a, b)]
    for prior in (
        ScenePrior.load(folder, adapter=[f"0.35*{paths[0]}", f"0.35*{paths[0]}", f"-0.2*{paths[1]}"]),
        ScenePrior.load(f"{folder} with 0.7*{paths[0]}+-0.2*{paths[1]}"),
        resolve_prior(f"{folder} with 0.7*{paths[0]}+-0.2*{paths[1]}"),
    ):
        for name, found in prior.weights().items():  # type: ignore[attr-defined]
            w0, w1, w2 = (each[name] for each in weights)
            torch.testing.assert_close(found, w0 + 0.7 * (w1 - w0) - 0.2 * (w2 - w0), rtol=1e-4, atol=1e-6)


def test_the_card_of_a_sum_has_no_figures_of_the_base_prior(tmp_path: Path) -> None:
    base = tiny_prior()
    base.card = {"iterations": 7, "measures": {"feasible_fraction": 0.8}, "limits": "none"}
    folder = base.save(tmp_path / "base")
    _fine_tuned(base, 1, "base").save(tmp_path / "run" / "prior")
    merged = ScenePrior.load(folder, adapter=f"0.5*{tmp_path / 'run'}")
    assert merged.card == {"iterations": 7, "post_training": {"base": "base", "sum": [{"factor": 0.5}]}}


@pytest.mark.usefixtures("blank_curves")
def test_the_card_of_a_run_names_its_base_as_it_was_loaded(tmp_path: Path) -> None:
    base = tiny_prior().save(tmp_path / "base")
    assert ScenePrior.load(base).loaded_as == str(base)
    post_train(small_config(tmp_path / "run", iterations=1), prior=ScenePrior.load(base))
    assert ScenePrior.load(tmp_path / "run").card["post_training"]["base"] == "base"
    half = ScenePrior.load(base, adapter=f"0.5*{tmp_path / 'run'}")
    assert half.loaded_as == f"{base} with 0.5*{tmp_path / 'run'}"
    post_train(small_config(tmp_path / "more", iterations=1), prior=half)
    assert ScenePrior.load(tmp_path / "more").card["post_training"]["base"] == f"base with 0.5*{tmp_path / 'run'}"
    post_train(small_config(tmp_path / "other", iterations=1), prior=tiny_prior())  # was not loaded
    assert "base" not in ScenePrior.load(tmp_path / "other").card["post_training"]


def test_the_card_of_a_sum_names_its_runs(tmp_path: Path) -> None:
    """Of two runs and of a sum that is itself an update, whose factors multiply."""
    base = tiny_prior()
    folder = base.save(tmp_path / "base")
    for seed, (name, algorithm) in enumerate((("a", "nft"), ("b", "awm"))):
        run = _fine_tuned(base, seed, "base")
        run.card["post_training"] |= {"algorithm": algorithm, "reward": "feasible_share", "iteration": 40 + seed}
        run.save(tmp_path / name)
    both = ScenePrior.load(folder, adapter=[f"0.5*{tmp_path / 'a'}", f"2*{tmp_path / 'b'}"])
    both.save(tmp_path / "both")
    half = ScenePrior.load(folder, adapter=f"0.5*{tmp_path / 'both'}")
    page = card_page("half", half, PriorFacts.of(half.save(tmp_path / "half")))
    assert (
        "the weights of `base` + 0.25 x (40 iterations of NFT toward `feasible_share`) + 1 x (41 iterations of AWM"
        in page
    )


def test_half_of_a_shipped_prior_is_the_mean_with_its_base() -> None:
    merged, base, other = (
        ScenePrior.load(name).weights()
        for name in ("pantry_shelf with 0.5*pantry_shelf_feasible", "pantry_shelf", "pantry_shelf_feasible")
    )
    for name, found in merged.items():
        torch.testing.assert_close(found, (base[name] + other[name]) / 2, rtol=1e-5, atol=1e-6)


def test_priors_that_were_not_trained_from_this_one_are_refused(tmp_path: Path) -> None:
    base = tiny_prior()
    folder = base.save(tmp_path / "base")
    elsewhere = _fine_tuned(base, 1, "pantry_shelf").save(tmp_path / "elsewhere")
    with pytest.raises(InvalidInputError, match=r"trained from 'pantry_shelf'.*added to .*base"):
        ScenePrior.load(folder, adapter=elsewhere)
    for other in (tiny_prior("pantry_shelf"), tiny_prior(process="mixed")):
        with pytest.raises(InvalidInputError, match="another network or scene type"):
            ScenePrior.load(folder, adapter=other.save(tmp_path / "other"))
    rescaled = _fine_tuned(base, 1, "base")
    rescaled.preconditioning.std.mul_(2)
    with pytest.raises(InvalidInputError, match="another normalizer or preconditioning"):
        ScenePrior.load(folder, adapter=rescaled.save(tmp_path / "rescaled"))


@pytest.mark.parametrize(
    ("word", "spec"),
    [("adapter=a", "a"), ("adapter=a+0.5*b", "a+0.5*b"), ("adapter=[a,b]", "a+b"), ("adapter=a,b", "a+b")],
)
def test_commands_take_adapters_where_they_take_a_prior(word: str, spec: str) -> None:
    assert compose("sample", SampleConfig, ["prior=pantry_shelf", word]).prior == f"pantry_shelf with {spec}"
    assert "adapter=" in help_text(SampleConfig)


def test_an_adapter_beside_a_prior_in_memory_is_not_dropped(base: ScenePrior) -> None:
    assert ScenePrior.load(base) is base
    with pytest.raises(InvalidInputError, match="give its name or folder, not the prior itself"):
        ScenePrior.load(base, adapter="runs/feasible")


def test_bad_files_and_sums_are_refused(tmp_path: Path) -> None:
    folder = tiny_prior().save(tmp_path / "base")
    for spec, said in (("nowhere", "nowhere"), ("x*a", "FACTOR"), ("a+", "FACTOR"), (str(tmp_path), "no prior")):
        with pytest.raises(SceneEnvsError, match=said):
            ScenePrior.load(folder, adapter=spec)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "config.json").write_text("{}")
    with pytest.raises(CorruptFileError):
        ScenePrior.load(folder, adapter=tmp_path / "broken")
