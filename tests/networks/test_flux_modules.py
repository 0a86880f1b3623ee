"""The modules of the Flux core: what leaving one out means, files of earlier versions, and wrong lists."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from agents import PretrainConfig
from agents.diffusion.gaussian import check_prediction
from agents.networks import MixedFlux, MixedFluxConfig, build_network, network_config
from agents.networks.contacts import ContactsConfig
from agents.networks.mixed_flux_files import current_fields, current_name
from agents.networks.observed_flags import ObservedFlagsConfig
from agents.networks.registry import config_from_state, config_state
from agents.networks.relations import RelationsConfig
from agents.prior_names import SHIPPED, list_priors
from agents.priors.base import ScenePrior
from scene_envs.errors import InvalidInputError, UnknownNameError

SIZES: dict[str, Any] = {"features": 20, "categories": 8, "hidden": 16, "depth": 2, "heads": 2}
ALL: dict[str, Any] = {
    "modules": [
        {"name": "observed_flags"},
        {"name": "pooled_text"},
        {"name": "count_embedding"},
        {"name": "count_conditioning", "largest": 9},
        {"name": "relations"},
        {"name": "rotation_features"},
        {"name": "contacts"},
    ],
    "text_width": 12,
}


def everything() -> MixedFluxConfig:
    config = network_config("flux", "mixed", **SIZES, **ALL)
    assert isinstance(config, MixedFluxConfig)
    return config


@pytest.mark.parametrize("name", [module.name for module in everything().modules])
def test_an_ablation_leaves_out_one_module_and_its_weights_alone(name: str) -> None:
    config = everything()
    gone = {"relations": ("relations", "contacts")}.get(name, (name,))  # contacts read the relations
    less = build_network(config.without(*gone))
    with_it, without_it = set(build_network(config).state_dict()), set(less.state_dict())
    gathered = {key for key in with_it if ".gathered." in key} if name == "relations" else set()
    assert with_it - without_it == {key for key in with_it if key.startswith(tuple(f"{n}." for n in gone))} | gathered
    assert without_it <= with_it
    pose = torch.randn(2, 5, 12)
    told: dict[str, Any] = {"position": pose, "noise_level": torch.ones(2, 5), "text": torch.randn(2, 12, 12)}
    output, logits = less(pose, torch.zeros(2, 5).long(), torch.ones(2), **told)
    assert output.shape == (2, 5, 12)
    assert logits.isfinite().all()


def test_the_core_alone_is_the_network_of_the_paper() -> None:
    core = build_network(everything().without(*(module.name for module in everything().modules)))
    sizes = {**vars(PretrainConfig(recipe="paper").network), "modules": ()}
    paper = network_config(process="mixed", features=20, categories=8, text_width=768, **sizes)
    assert isinstance(paper, MixedFluxConfig)
    assert paper.modules == ()
    first = {name.partition(".")[0] for name in core.state_dict()}
    with torch.device("meta"):
        assert {name.partition(".")[0] for name in MixedFlux(paper).state_dict()} == first


LATER = ("_continuous", "_feasible", "_completion")
"""Ends of the names of shipped priors that are not mixed, or were saved under the present names."""


@pytest.mark.parametrize("name", [name for name in list_priors() if not name.endswith(LATER)])
def test_weights_of_shipped_priors_reach_the_modules_under_their_present_names(name: str) -> None:
    """The files are of an earlier version; every tensor in them is found again, bit for bit."""
    prior, state = ScenePrior.load(name), json.loads((SHIPPED / name / "config.json").read_text())["prior"]
    assert "modules" not in state["network"]
    loaded = prior.denoiser.network.state_dict()
    (file,) = Path(SHIPPED / name).glob("*.safetensors")
    stored = {key: value for key, value in load_file(file).items() if not key.startswith(("text_encoder.", "residual"))}
    assert {current_name(key) for key in stored} == set(loaded)
    assert all(
        torch.equal(loaded[current_name(key)], value.to(loaded[current_name(key)])) for key, value in stored.items()
    )
    assert (state["prediction"], prior.denoiser.poses.prediction) == ("karras", "edm")
    again = config_from_state(json.loads(json.dumps(config_state(prior.denoiser.network.config))), "mixed")
    assert again == prior.denoiser.network.config


def test_flat_fields_of_earlier_files_say_which_modules_there_are() -> None:
    fields = {"categories": 8, "attention": "plain", "contacts": 1, "frequencies": 0, "flags": 0, "requests": 9}
    assert current_fields(fields) == {"categories": 8, "modules": [], "time_input": "timestep"}
    relative = current_fields({**fields, "attention": "relative", "relation_blur": "largest", "text_width": 4})
    assert [module["name"] for module in relative["modules"]] == ["count_conditioning", "relations", "contacts"]
    assert current_fields(relative) == relative


def test_wrong_lists_of_modules_are_named() -> None:
    with pytest.raises(InvalidInputError, match="'contacts' needs relations before it"):
        MixedFluxConfig(8, modules=(ContactsConfig(), RelationsConfig()))
    with pytest.raises(InvalidInputError, match="listed twice"):
        MixedFluxConfig(8, modules=(ObservedFlagsConfig(), ObservedFlagsConfig()))
    with pytest.raises(InvalidInputError, match="'pooled_text' needs a network with text"):
        MixedFluxConfig(8, modules=({"name": "pooled_text"},))  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="did you mean 'contacts'"):
        MixedFluxConfig(8, modules=({"name": "contact"},))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match=r"'relations' has no fields \['blurr'\]"):
        MixedFluxConfig(8, modules=({"name": "relations", "blurr": "axis"},))  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="contacts"):
        MixedFluxConfig(8, modules=(ObservedFlagsConfig(),)).without("contacts")


def test_an_earlier_name_of_a_prediction_says_the_present_one() -> None:
    with pytest.raises(InvalidInputError, match="prediction='karras' has another name now: prediction='edm'"):
        check_prediction("karras")
