"""Refinement: extents of boxes, and the correction of poses from the denoised scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Generator, Tensor, nn

from agents.networks import MixedFlux, MixedFluxConfig, build_network
from agents.networks.geometry import ContactsConfig, RefinementConfig, RelationsConfig, reach
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.small_runs import with_modules

SHAPES = ((0.0, 0.0, 0.1, 0.2, 0.1, 0.1), (0.0, 0.05, 0.0, 0.1, 0.1, 0.3), (0.0, 0.0, 0.0, 0.3, 0.3, 0.1))
MODULES = (RelationsConfig(), ContactsConfig())


def turned(count: int) -> Tensor:
    return torch.tensor(Rotation.random(count, random_state=0).as_matrix())[None]


@pytest.mark.parametrize("roundness", [0.0, 1.0])
def test_reach_is_the_farthest_point_of_either_object_along_each_gap(roundness: float) -> None:
    """Boxes reach as far as their corners, ellipsoids as far as points all over their surface."""
    generator = Generator().manual_seed(0)
    half, rotation = 0.1 + torch.rand(1, 3, 3, generator=generator).double(), turned(3)
    toward = nn.functional.normalize(torch.randn(2, 1, 3, 3, generator=generator).double(), dim=0)
    found = reach(rotation.movedim((-2, -1), (0, 1)), toward, half, torch.full((1, 3), roundness).double())
    if roundness:
        points = nn.functional.normalize(torch.randn(200_000, 3, generator=generator).double(), dim=-1)
    else:
        points = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0]).double()] * 3)
    surfaces = [(points * half[0, slot]) @ rotation[0, slot].T for slot in range(3)]
    for i, j in ((0, 1), (2, 0), (1, 2)):
        level = torch.cat([toward[:, 0, i, j], torch.zeros(1)])
        ways = [level, torch.tensor([0.0, 0.0, 1.0]).double(), *rotation[0, i].T, *rotation[0, j].T]
        far = [float((surfaces[i] @ way).max() + (surfaces[j] @ way).max()) for way in ways]
        assert found[:, 0, i, j].tolist() == pytest.approx(far, rel=5e-3 if roundness else 1e-9)


def network() -> MixedFlux:
    torch.manual_seed(0)
    made = MixedFlux(MixedFluxConfig(categories=4, hidden=16, heads=2, embedding=16, modules=MODULES)).double()
    for parameter in made.parameters():
        nn.init.normal_(parameter, std=0.3)
    return made


def inputs(slots: int = 5) -> dict[str, Any]:
    generator = Generator().manual_seed(1)
    pose, offset, scale = torch.randn(3, 2, slots, 12, generator=generator).double()
    states = torch.randint(5, (2, slots), generator=generator)
    return {
        "pose": pose, "states": states, "time": torch.ones(2).double(), "position": 0.3 * pose,
        "noise_level": torch.full((2, slots), 0.05).double(), "clean_offset": 0.3 * offset, "clean_scale": 0.1 * scale,
    }  # fmt: skip


def trained() -> MixedFlux:
    refined = network().extended(RefinementConfig(SHAPES)).double()
    for parameter in refined.refinement.parameters():
        nn.init.normal_(parameter, std=0.3)
    return refined


def test_a_new_refinement_corrects_nothing_and_learns() -> None:
    plain, given = network(), inputs()
    refined = plain.extended(RefinementConfig(SHAPES)).double()
    assert refined.config == replace(plain.config, modules=(*MODULES, RefinementConfig(SHAPES)))
    told = {name: value for name, value in given.items() if not name.startswith("clean")}
    for before, after in zip(plain(**told), refined(**given), strict=True):
        torch.testing.assert_close(after, before, rtol=0, atol=0)
    refined.requires_grad_(False)
    refined.refinement.requires_grad_(True)
    refined(**given)[0].square().sum().backward()
    for layer in (refined.refinement.pose_out[-1], refined.refinement.touching.gates):
        assert layer.weight.grad.abs().max() > 0


def test_poses_are_corrected_and_logits_are_not() -> None:
    refined, given = trained(), inputs()
    plain = build_network(refined.config.without("refinement")).double()
    plain.load_state_dict(refined.state_dict(), strict=False)
    told = {name: value for name, value in given.items() if not name.startswith("clean")}
    (before, logits), (after, same) = plain(**told), refined(**given)
    assert (after - before).abs().amax(dim=(1, 2)).min() > 1e-3
    torch.testing.assert_close(same, logits, rtol=0, atol=0)
    torch.testing.assert_close(refined(**told)[0], before, rtol=0, atol=0)


def test_it_reads_the_denoised_scene_and_observed_poses_as_they_are() -> None:
    """The denoised pose is offset + scale * output; where the pose is observed, neither of them counts."""
    refined, given = trained(), inputs()
    first, _ = refined(**given)
    given["clean_offset"][0, 0] += 0.1
    second, _ = refined(**given)
    assert (second[0] - first[0]).abs().max() > 1e-4
    torch.testing.assert_close(second[1], first[1], rtol=0, atol=0)
    given["noise_level"][0, 0] = 0.0
    observed, _ = refined(**given)
    given["clean_offset"][0, 0] -= 0.3
    torch.testing.assert_close(refined(**given)[0], observed, rtol=0, atol=0)


def test_positions_that_are_observed_or_uncertain_by_centimetres_are_not_corrected() -> None:
    """The error of a denoised position is 0.7 of its noise; 0.06 of it makes more than 4 cm, in units of a metre."""
    refined, given = trained(), inputs()
    plain = build_network(refined.config.without("refinement")).double()
    plain.load_state_dict(refined.state_dict(), strict=False)
    given["noise_level"][0], given["noise_level"][1, 0], given["noise_level"][1, 1] = 0.06, 0.06, 0.0
    told = {name: value for name, value in given.items() if not name.startswith("clean")}
    change = (refined(**given)[0] - plain(**told)[0]).abs().amax(dim=-1)
    assert change[0].max() == change[1, :2].max() == 0
    assert change[1, 2:].min() > 1e-4


def test_slots_are_a_set_and_padding_changes_nothing() -> None:
    refined, given = trained(), inputs()
    output, _ = refined(**given)
    order = torch.tensor([3, 0, 4, 1, 2])
    shuffled = {name: value if name == "time" else value[:, order] for name, value in given.items()}
    torch.testing.assert_close(refined(**shuffled)[0], output[:, order])
    padded = {name: value if name == "time" else torch.cat([value, value[:, :2]], 1) for name, value in given.items()}
    mask = torch.arange(7).expand(2, -1) < 5
    torch.testing.assert_close(refined(**padded, slot_mask=mask)[0][:, :5], output)


@pytest.fixture(params=[MODULES, MODULES[:1]], ids=["contacts", "relations"])
def prior(request: pytest.FixtureRequest) -> MixedPrior:
    return with_modules(tiny_prior("dimsum_table", process="mixed"), *request.param)


def test_a_refinement_is_saved_with_its_prior_and_left_out_of_guided_chains(prior: MixedPrior, tmp_path: Path) -> None:
    before, guided = (prior.sample(2, num_steps=4, seed=0, physics_guidance=strength) for strength in (0.0, 1.0))
    moved = prior.rearrange(before, num_steps=4, physics_guidance=1.0)
    refined = prior.with_module("refinement")
    torch.testing.assert_close(refined.sample(2, num_steps=4, seed=0).tensor, before.tensor, rtol=0, atol=0)
    assert refined.with_module("refinement") is refined
    for parameter in refined.denoiser.network.refinement.parameters():
        nn.init.normal_(parameter, std=0.3)
    refined.save(tmp_path)
    loaded = ScenePrior.load(tmp_path)
    after = loaded.sample(2, num_steps=4, seed=0)
    torch.testing.assert_close(after.tensor, refined.sample(2, num_steps=4, seed=0).tensor, rtol=0, atol=0)
    assert not torch.equal(after.tensor, before.tensor)
    assert torch.equal(loaded.sample(2, num_steps=4, seed=0, physics_guidance=1.0).tensor, guided.tensor)
    assert torch.equal(loaded.rearrange(before, num_steps=4, physics_guidance=1.0).tensor, moved.tensor)


def test_a_timestep_of_all_scenes_and_one_of_each_denoise_alike(prior: MixedPrior) -> None:
    """Chains give one timestep, training gives one of each scene."""
    refined = prior.with_module("refinement")
    for parameter in refined.denoiser.network.refinement.parameters():
        nn.init.normal_(parameter, std=0.1)
    x = refined.initial(3, 8, Generator().manual_seed(0))
    for step in (5, 100):
        together, _ = refined.denoiser(x, step)
        each, _ = refined.denoiser(x, torch.full((3,), step))
        torch.testing.assert_close(each, together, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_a_prior_without_relations_is_refused(process: str) -> None:
    tiny = tiny_prior("dimsum_table", process=process)
    with pytest.raises(InvalidInputError, match="refinement needs a mixed flux network"):
        tiny.with_module("refinement")
