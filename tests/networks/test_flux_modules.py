"""The modules of the Flux core: what leaving one out means, files, and wrong lists."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

from agents import PretrainConfig
from agents.configuration.prior_names import SHIPPED, list_priors
from agents.networks import MixedFlux, MixedFluxConfig, build_network, network_config
from agents.networks.flux_modules import ObservedFlagsConfig
from agents.networks.geometry import ContactsConfig, RelationsConfig
from agents.priors.prior import ScenePrior
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
    paper_network = vars(PretrainConfig(recipe="paper").network)
    sizes = {**paper_network, **vars(paper_network["flux"]), "modules": ()}
    del sizes["flux"]
    paper = network_config(process="mixed", features=20, categories=8, text_width=768, **sizes)
    assert isinstance(paper, MixedFluxConfig)
    assert paper.modules == ()
    first = {name.partition(".")[0] for name in core.state_dict()}
    with torch.device("meta"):
        assert {name.partition(".")[0] for name in MixedFlux(paper).state_dict()} == first


@pytest.mark.parametrize("name", list_priors())
def test_files_of_shipped_priors_have_the_present_fields_and_tensors(name: str) -> None:
    prior = ScenePrior.load(name)
    stored = json.loads((SHIPPED / name / "config.json").read_text())["prior"]
    assert json.loads(json.dumps(prior.config_state())) == {"physics_guidance": 0.0, **stored}
    tensors = load_file(SHIPPED / name / "model.safetensors")
    assert {key for key in tensors if not key.startswith("residual.")} == set(prior.weights())
    assert all(torch.equal(value, tensors[key].to(value)) for key, value in prior.weights().items())


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
