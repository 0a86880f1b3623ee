"""Adapters: low-rank updates of a prior's attention and MLP matrices, in files of their own."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from torch import Generator

from agents.cli.commands.sample import SampleConfig
from agents.cli.main import help_text
from agents.configuration import compose
from agents.networks import network_config
from agents.networks.low_rank import low_rank_tensors, matrices
from agents.networks.registry import build_network
from agents.priors import ScenePrior, list_priors
from agents.priors.adapters import ADAPTER_NAME, attach_adapter, save_adapter
from agents.priors.card import card_page
from agents.priors.facts import PriorFacts
from agents.priors.testing import tiny_prior
from scene_envs.envs.resolvers import resolve_prior
from scene_envs.errors import CorruptFileError, InvalidInputError

RANK, SCALE = 2, 4.0


def _adapted(base: ScenePrior, name: str, seed: int, *, moved: bool = True) -> ScenePrior:
    """A copy with an adapter, whose updates are random if ``moved``."""
    prior = deepcopy(base)
    attach_adapter(prior, name, rank=RANK, scale=SCALE, seed=seed)
    if moved:
        generator = Generator().manual_seed(seed)
        with torch.no_grad():
            for tensor in low_rank_tensors(prior.denoiser.network).values():
                tensor.copy_(0.05 * torch.randn(tensor.shape, generator=generator))
    return prior


@pytest.fixture(params=["continuous", "mixed"])
def base(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior(process=request.param)


def test_a_new_adapter_changes_nothing(base: ScenePrior) -> None:
    prior = _adapted(base, "tiny", 0, moved=False)
    before, after = (each.sample(2, num_steps=4, seed=1).tensor for each in (base, prior))
    assert torch.equal(before, after)


def test_the_gradient_reaches_the_adapter_alone(base: ScenePrior) -> None:
    prior = _adapted(base, "tiny", 0)
    prior.pretraining_loss(prior.encode(prior.sample(2, num_steps=3)), Generator().manual_seed(0)).backward()
    trained = {id(tensor) for tensor in low_rank_tensors(prior.denoiser.network).values()}
    assert trained
    assert {id(p) for p in prior.parameters() if p.requires_grad} == trained
    with_gradient = {id(p) for p in prior.parameters() if p.grad is not None}
    assert with_gradient <= trained
    assert len(with_gradient) >= len(trained) - 8  # blocks that read text have none here


def test_a_saved_prior_has_the_updates_in_its_weights(base: ScenePrior, tmp_path: Path) -> None:
    """base + scale * up @ down, by the prior's own file, by its adapter, and by hand; names are those of the base."""
    base.save(tmp_path / "base")
    prior = _adapted(base, str(tmp_path / "base"), 0)
    save_adapter(prior, tmp_path)
    prior.save(tmp_path / "whole")
    loaded = ScenePrior.load(tmp_path / "base", adapter=tmp_path)
    whole, plain, updates = (
        ScenePrior.load(tmp_path / "whole"),
        base.weights(),
        low_rank_tensors(prior.denoiser.network),
    )
    assert whole.weights().keys() == plain.keys()
    for name, weight in plain.items():
        layer = name.removesuffix(".weight")
        change = SCALE * updates[f"{layer}.up"] @ updates[f"{layer}.down"] if f"{layer}.up" in updates else 0.0
        for found in (whole, loaded):
            assert torch.allclose(found.weights()[name], weight + change, atol=1e-6)
    samples = [each.sample(2, num_steps=3, seed=0).tensor for each in (prior, whole, loaded)]
    assert torch.allclose(samples[0], samples[1], atol=1e-3)
    assert torch.allclose(samples[0], samples[2], atol=1e-3)


def test_adapters_add_with_factors_and_any_spelling_of_a_sum(tmp_path: Path) -> None:
    base = tiny_prior()
    folder = base.save(tmp_path / "base")
    a, b = (_adapted(base, str(folder), seed) for seed in (1, 2))
    paths = [str(save_adapter(prior, tmp_path / name).parent) for prior, name in ((a, "a"), (b, "b"))]
    key = next(matrices(base.denoiser.network))[0] + ".weight"
    weight = base.weights()[key]
    expected = weight + (a.weights()[key] - weight) + 0.5 * (b.weights()[key] - weight)
    for prior in (
        ScenePrior.load(folder, adapter=f"{paths[0]}+0.5*{paths[1]}"),
        ScenePrior.load(folder, adapter=[paths[0], f"0.5*{paths[1]}"]),
        ScenePrior.load(f"{folder} with {paths[0]}+0.5*{paths[1]}/{ADAPTER_NAME}"),
        resolve_prior(f"{folder} with {paths[0]}+0.5*{paths[1]}"),
    ):
        assert torch.allclose(prior.weights()[key], expected, atol=1e-6)  # type: ignore[attr-defined]


def _fine_tuned(prior: ScenePrior, seed: int, base: str) -> ScenePrior:
    """A copy with other weights, as of a run from the prior ``base`` that trained all of them."""
    prior = deepcopy(prior)
    generator = Generator().manual_seed(seed)
    prior.load_weights(
        {name: w + 0.05 * torch.randn(w.shape, generator=generator) for name, w in prior.weights().items()}
    )
    prior.card = {"post_training": {"base": base}}
    return prior


def test_fine_tuned_priors_and_adapters_add(base: ScenePrior, tmp_path: Path) -> None:
    """base + 0.7 (a - base) - 0.2 (b - base) + the low-rank update, of every weight; a term may come twice."""
    folder = base.save(tmp_path / "base")
    a, b = (_fine_tuned(base, seed, "base") for seed in (1, 2))
    low_rank = _adapted(base, str(folder), 3)
    save_adapter(low_rank, tmp_path / "c")
    run = a.save(tmp_path / "run" / "prior").parent
    merged = ScenePrior.load(
        folder, adapter=[f"0.35*{run}", f"0.35*{run}", f"-0.2*{b.save(tmp_path / 'b')}", tmp_path / "c"]
    )
    weights = [prior.weights() for prior in (base, a, b, low_rank)]
    for name, found in merged.weights().items():
        w0, w1, w2, w3 = (each[name] for each in weights)
        torch.testing.assert_close(found, w0 + 0.7 * (w1 - w0) - 0.2 * (w2 - w0) + (w3 - w0), rtol=1e-4, atol=1e-6)


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


def test_the_card_of_a_sum_names_its_low_rank_updates(tmp_path: Path) -> None:
    """Without the figures of the base prior, which are not those of the sum."""
    base = tiny_prior()
    base.card = {"iterations": 7, "measures": {"feasible_fraction": 0.8}, "limits": "none"}
    folder = base.save(tmp_path / "base")
    save_adapter(_adapted(base, str(folder), 0), tmp_path / "run")
    for named in ("run", "run/adapter.safetensors"):
        merged = ScenePrior.load(folder, adapter=f"0.5*{tmp_path / named}")
        expected = {"base": "base", "sum": [{"factor": 0.5, "name": "run"}]}
        assert merged.card == {"iterations": 7, "post_training": expected}


def test_half_of_a_shipped_prior_is_the_mean_with_its_base() -> None:
    merged, base, other = (
        ScenePrior.load(name).weights()
        for name in ("dimsum_table with 0.5*dimsum_table_feasible", "dimsum_table", "dimsum_table_feasible")
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


def test_an_adapter_of_another_prior_is_refused_and_both_are_named(tmp_path: Path) -> None:
    base, other = tiny_prior(), tiny_prior(seed=1)
    folder, others = base.save(tmp_path / "base"), other.save(tmp_path / "other")
    save_adapter(_adapted(base, str(folder), 0), tmp_path)
    with pytest.raises(InvalidInputError, match=r"base'.* not on .*other'"):
        ScenePrior.load(others, adapter=tmp_path)
    other.save(folder)
    with pytest.raises(InvalidInputError, match="have changed since"):
        ScenePrior.load(folder, adapter=tmp_path)


def test_an_adapter_beside_a_prior_in_memory_is_not_dropped(base: ScenePrior) -> None:
    assert ScenePrior.load(base) is base
    with pytest.raises(InvalidInputError, match="give its name or folder, not the prior itself"):
        ScenePrior.load(base, adapter="runs/feasible")


def test_bad_files_and_sums_are_refused(tmp_path: Path) -> None:
    base = tiny_prior()
    folder = base.save(tmp_path / "base")
    save_adapter(_adapted(base, str(folder), 0), tmp_path)
    for spec, said in (
        ("nowhere", "nowhere"),
        ("x*a", "FACTOR"),
        ("a+", "FACTOR"),
        (str(tmp_path / "runs"), "no .*adapter"),
    ):
        with pytest.raises(InvalidInputError, match=said):
            ScenePrior.load(folder, adapter=spec)
    (tmp_path / ADAPTER_NAME).write_bytes(b"not tensors")
    with pytest.raises(CorruptFileError):
        ScenePrior.load(folder, adapter=tmp_path)
    (tmp_path / "adapter.json").write_text("{}")
    with pytest.raises(CorruptFileError, match="description"):
        ScenePrior.load(folder, adapter=tmp_path)
    (tmp_path / ADAPTER_NAME).unlink()
    with pytest.raises(InvalidInputError, match="rank=99"):
        attach_adapter(base, "tiny", rank=99, scale=1.0, seed=0)


@pytest.mark.parametrize("name", list_priors())
def test_adapters_of_shipped_priors_are_small(name: str, tmp_path: Path) -> None:
    prior = ScenePrior.load(name)
    attach_adapter(prior, name, rank=4, scale=1.0, seed=0)
    assert save_adapter(prior, tmp_path).stat().st_size < 2**20
    assert json.loads((tmp_path / "adapter.json").read_text())["prior"] == name


@pytest.mark.parametrize("name", ["flux", "midiffusion", "diffuscene"])
@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_every_network_has_attention_matrices(name: str, process: str) -> None:
    network = build_network(network_config(name, process, features=20, categories=8, hidden=16, depth=1, heads=2))
    assert any(layer.weight.shape[0] >= 16 for _, layer in matrices(network))
