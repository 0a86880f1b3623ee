"""Files of priors: half precision, prompts of shipped priors, and folders of foreign priors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from agents.configuration.prior_names import SHIPPED, list_priors
from agents.priors.files import ASSET_FOLDERS, PriorFacts, to_precision
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar

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


READERS = [name for name in list_priors() if PriorFacts.of(name).text]
NARROWER = ("cotrained", "restaurant_high_clutter")
"""Priors that are asked for numbers of their own samples: a union has no grammar, and few real rooms are so full."""


def test_weights_of_all_priors_fit_into_64_mib() -> None:
    assert sum(file.stat().st_size for file in SHIPPED.rglob("*.safetensors")) <= 64 * 2**20


@pytest.mark.parametrize("name", list_priors())
def test_every_prior_has_a_card_with_figures_beside_those_of_real_scenes(name: str) -> None:
    card = (SHIPPED / name / "README.md").read_text()
    assert f"# Prior `{name}`" in card


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_the_number_of_objects_follows_the_prompt(name: str) -> None:
    """A small and a large number among those of real scenes, or of its own; without reading it would miss both.

    In a seventh of the steps that its card measures it with. A prior of all types has the wider spread of all, and
    misses by half of what it would without reading, or by less.
    """
    prior = ScenePrior.load(name)
    if name in NARROWER:
        free = prior.sample(8, num_steps=7, seed=0).counts.sort().values
    else:
        free = get_grammar(prior.scene_type.name).sample(np.random.default_rng(0), 8).counts.sort().values
    numbers = (int(free[1]), int(free[-2]))
    prompts = [f"A scene with {asked} objects." for asked in numbers for _ in range(4)]
    read = prior.sample(len(prompts), prompt=prompts, guidance=1.0, num_steps=7, seed=1).counts
    missed, unread = [], []
    for asked, counts in zip(numbers, read.split(4), strict=True):
        missed.append(float((counts - asked).abs().float().mean()))
        unread.append(float((free - asked).abs().float().mean()))
    if "+" not in prior.scene_type.name:
        assert max(missed) < max(1.0, 0.4 * float(free.float().std()))
    assert sum(missed) < max(2.0, 0.5 * sum(unread))


@pytest.fixture
def foreign(tmp_path):
    """A prior whose configuration can be changed."""
    tiny_prior().save(tmp_path / "prior")
    path = tmp_path / "prior" / "config.json"

    def change(**changes):
        config = json.loads(path.read_text())
        config.pop("sha256", None)  # as the author of a foreign prior would
        for key, value in changes.items():
            if isinstance(value, dict):
                config[key] |= value
            else:
                config[key] = value
        path.write_text(json.dumps(config))
        return tmp_path / "prior"

    return change


def test_folders_of_assets_outside_the_prior_are_not_read(foreign, monkeypatch, tmp_path, caplog):
    own = tmp_path / "prior" / "assets"
    folder = foreign(
        prior={"scene_type": "from_elsewhere"},
        scene_type={"name": "from_elsewhere", "asset_folders": ["/", str(own), str(own / ".." / "..")]},
    )
    monkeypatch.delenv(ASSET_FOLDERS, raising=False)
    assert ScenePrior.load(folder).scene_type.asset_folders == (str(own),)
    assert "outside its own" in caplog.text


def test_folders_of_assets_that_the_user_names_are_read(foreign, monkeypatch, tmp_path):
    mine = tmp_path / "mine"
    folder = foreign(
        prior={"scene_type": "with_my_assets"},
        scene_type={"name": "with_my_assets", "asset_folders": [str(mine / "cups"), "/etc"]},
    )
    monkeypatch.setenv(ASSET_FOLDERS, str(mine))
    assert ScenePrior.load(folder).scene_type.asset_folders == (str(mine / "cups"),)


@pytest.mark.parametrize("sizes", [{"slots": 10**9}, {"num_timesteps": 10**12}])
def test_sizes_beyond_the_weights_are_refused_before_anything_is_built(foreign, sizes):
    with pytest.raises(CorruptFileError, match=rf"asks for {next(iter(sizes))}="):
        ScenePrior.load(foreign(prior=sizes))


def test_a_network_wider_than_its_weights_is_refused(foreign, tmp_path):
    config = json.loads((tmp_path / "prior" / "config.json").read_text())
    for key in ("hidden", "depth"):
        with pytest.raises(CorruptFileError, match=rf"asks for {key}="):
            ScenePrior.load(foreign(prior={"network": {**config["prior"]["network"], key: 10**8}}))


@pytest.mark.parametrize("text", ["[" * 100_000, "[]", "3", '{"prior": 1' + "0" * 5000 + "}", "\x00"])
def test_a_configuration_that_is_none_names_the_prior(foreign, text):
    folder = foreign()
    (folder / "config.json").write_text(text)
    with pytest.raises(CorruptFileError, match="prior"):
        ScenePrior.load(folder)


def test_a_normaliser_that_lacks_a_part_names_the_prior(foreign):
    with pytest.raises(InvalidInputError, match=r"prior '.*prior'.*normalizer_state lacks 'input_stats'"):
        ScenePrior.load(foreign(normalizer_state={"params": {"scale": [1.0], "min": [0.0]}}))


_NO_PRIORS = [
    {"preconditioning": "text"},
    {"preconditioning": {"mean": [0.0]}},
    {"preconditioning": {"mean": [float("nan")] * 20}},
    {"normalizer_state": {"params": {"scale": 1.0, "min": 0.0, "input_stats": {"min": 0.0, "max": 1.0}}}},
    {"normalizer_state": {"params": {"scale": ["a"], "min": [0.0], "input_stats": {"min": [0.0], "max": [1.0]}}}},
    {"prior": {"network": None}},
    {"prior": {"network": [1]}},
    {"prior": {"slots": "many"}},
    {"prior": {"noise_mean": [1.0]}},
    {"prior": {"scene_type": "of_nobody"}, "scene_type": 3},
    {"process": None},
]


@pytest.mark.parametrize("changes", _NO_PRIORS, ids=str)
def test_values_of_wrong_type_name_the_prior(foreign, changes):
    with pytest.raises((CorruptFileError, InvalidInputError, UnknownNameError), match=r"prior'"):
        ScenePrior.load(foreign(**changes))


@pytest.mark.parametrize("change", [{"heads": 0}, {"mlp_ratio": "~"}, {"time_scale": None}, {"hidden": 1.5}], ids=str)
def test_sizes_of_wrong_type_of_a_network_name_the_prior(foreign, tmp_path, change):
    network = json.loads((tmp_path / "prior" / "config.json").read_text())["prior"]["network"]
    with pytest.raises((CorruptFileError, InvalidInputError), match=r"prior'"):
        ScenePrior.load(foreign(prior={"network": {**network, **change}}))


@pytest.mark.parametrize("prompt", [3, ["a", 3], {"a": 1}, 2.5])
def test_a_prompt_is_text(prompt):
    with pytest.raises(InvalidInputError, match="must be a text"):
        tiny_prior().sample(1, prompt=prompt, num_steps=1)


@pytest.mark.parametrize("name", ["a" * 300, "a/" * 3000, "\x00", "a" * 10**6])
def test_a_name_that_no_file_can_have_is_refused_in_a_few_words(name):
    with pytest.raises((InvalidInputError, KeyError)) as caught:
        ScenePrior.load(name)
    assert len(str(caught.value)) < 7000


@pytest.mark.slow
def test_the_shipped_priors_pass_their_own_bounds():
    for config in Path("agents/priors/shipped").glob("*/config.json"):
        assert ScenePrior.load(config.parent.name).scene_type.slots > 0
