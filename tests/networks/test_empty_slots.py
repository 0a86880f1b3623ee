"""Omission of known empty slots from the network: unchanged results for all other slots."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from agents.networks import MixedFluxConfig
from agents.networks.denoisers import pack
from agents.networks.geometry import RelationsConfig
from agents.priors.mixed import MixedPrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError


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
