"""Priors from untrusted folders: no file read outside the folder, and no network larger than the stored weights."""

import json
from pathlib import Path

import pytest

from agents.priors import ScenePrior
from agents.priors.files import ASSET_FOLDERS
from agents.priors.testing import tiny_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError


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
