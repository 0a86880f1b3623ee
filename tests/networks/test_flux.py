"""The Flux core: what leaving a module out means, empty slots, files, and wrong lists."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from agents import PretrainConfig
from agents.configuration.prior_names import SHIPPED, list_priors
from agents.networks import MixedFlux, MixedFluxConfig, build_network, network_config
from agents.networks.denoisers import pack
from agents.networks.flux_modules import ObservedFlagsConfig
from agents.networks.geometry import ContactsConfig, RelationsConfig
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
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
        {"name": "count_logits"},
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
    network = vars(PretrainConfig(recipe="paper").network)
    sizes = {**network, **vars(network["flux"]), "modules": ()}
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


def _prior(attention: str = "relative", kernel: str = "early_absorbing") -> MixedPrior:
    tiny = tiny_prior("dimsum_table", process="mixed")
    assert isinstance(tiny, MixedPrior)
    assert isinstance(tiny.config.network, MixedFluxConfig)
    added = (RelationsConfig(),) if attention == "relative" else ()
    network = replace(tiny.config.network, modules=(*tiny.config.network.modules, *added))
    config = replace(tiny.config, kernel=kernel, empty_slots="dropped", network=network)
    torch.manual_seed(0)
    prior = MixedPrior(config, tiny.normalizer, tiny.preconditioning)
    for parameter in prior.parameters():
        nn.init.normal_(parameter, std=0.1)
    return prior.eval()


def _noised(prior: MixedPrior, count: int, level: int) -> torch.Tensor:
    """Scenes of one to ``count`` objects beside the table, at a noise level."""
    batch = prior.sample(count, num_steps=2, seed=0)
    tensor = batch.tensor.clone()
    for row in range(count):
        tensor[row, 2 + row :] = 0.0
        tensor[row, 2 + row :, -1] = 1.0
    x0 = prior.encode(type(batch)(tensor, batch.scene_type))
    noise = torch.randn(x0.shape, generator=torch.Generator().manual_seed(1))
    return prior.add_noise(x0, torch.full((count,), level), noise)


def test_pack_keeps_every_scene_once_and_its_active_slots_first() -> None:
    active = torch.rand(37, 12, generator=torch.Generator().manual_seed(0)) < 0.4
    seen = []
    for rows, index, mask in pack(active):
        seen += rows.tolist()
        assert torch.equal(mask.sum(dim=1), active[rows].sum(dim=1))
        assert bool(active[rows].gather(1, index)[mask].all())
        assert mask.shape[1] == max(1, int(active[rows].sum(dim=1).max()))
    assert sorted(seen) == list(range(37))


@pytest.mark.parametrize("attention", ["plain", "relative"])
def test_known_empty_slots_change_nothing(attention: str) -> None:
    """With every category known, a scene and the same scene with more empty slots are denoised alike."""
    prior = _prior(attention)
    level = prior.config.num_timesteps // 4
    x = _noised(prior, 20, level)
    t = torch.full((len(x),), level)
    pose, _ = prior.denoiser(x, t)
    for row in (0, 7, 19):
        short = x[row : row + 1, : 2 + row]
        alone, _ = prior.denoiser(short, t[:1])
        torch.testing.assert_close(alone[0], pose[row, : 2 + row], atol=2e-6, rtol=0)


def test_a_seen_category_is_certain_and_a_masked_one_is_not() -> None:
    prior = _prior()
    x = _noised(prior, 20, 3 * prior.config.num_timesteps // 4)
    with torch.no_grad():
        _, logits = prior.denoiser(x, torch.full((len(x),), 3 * prior.config.num_timesteps // 4))
    states = x[..., 12:].argmax(dim=-1)
    masked = x[..., 12:].sum(dim=-1) == 0
    assert bool(masked.any())
    assert bool((~masked).any())
    chances = logits.softmax(dim=-1)
    assert float(chances.gather(-1, states[..., None])[..., 0][~masked].min()) > 1 - 1e-9
    assert float(chances[masked].max()) < 0.999


def test_slots_may_be_permuted() -> None:
    prior = _prior()
    level = 3 * prior.config.num_timesteps // 4
    x = _noised(prior, 20, level)
    t = torch.full((len(x),), level)
    order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(3))
    for straight, permuted in zip(prior.denoiser(x, t), prior.denoiser(x[:, order], t), strict=True):
        torch.testing.assert_close(straight[:, order], permuted, atol=2e-6, rtol=0)


def test_the_loss_is_finite_and_reaches_every_parameter_but_that_of_certain_things() -> None:
    prior = _prior()
    x0 = prior.encode(prior.sample(16, num_steps=4, seed=2))
    prior.pretraining_loss(x0, torch.Generator().manual_seed(0)).backward()  # type: ignore[no-untyped-call]
    missing = [name for name, p in prior.denoiser.network.named_parameters() if p.grad is None or not p.grad.any()]
    assert missing == []


def test_a_kernel_that_replaces_categories_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="early_absorbing"):
        _prior(kernel="mask_and_replace")


@pytest.mark.parametrize("attention", ["plain", "relative"])
def test_a_scene_that_is_known_to_be_empty_leaves_others_and_gradients_alone(attention: str) -> None:
    prior = _prior(attention)
    x = _noised(prior, 3, 200)
    blank = torch.zeros_like(x[:1])
    blank[..., -1] = 1.0
    t = torch.full((4,), 200)
    pose, logits = prior.denoiser.output(torch.cat([x, blank]), t)
    alone, _ = prior.denoiser.output(x, t[:3])
    torch.testing.assert_close(pose[:3], alone, atol=2e-6, rtol=0)
    assert not bool(pose[3].any())
    (pose.square().sum() + logits.square().sum()).backward()  # type: ignore[no-untyped-call]
    assert all(bool(p.grad.isfinite().all()) for p in prior.denoiser.network.parameters() if p.grad is not None)
