"""Rotations as matrices, quaternions and axis-angle vectors: conversions against SciPy, and priors of each."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from agents.diffusion import GaussianStep, Preconditioning
from agents.diffusion.reverse_steps import gaussian_log_prob
from agents.networks import FluxConfig, MixedFluxConfig
from agents.networks.registry import network_config
from agents.post_training import DDPOSFLoss, DenoisingPolicy
from agents.post_training.rollouts import collect
from agents.priors.continuous import (
    ROTATION_WIDTHS,
    ROTATIONS,
    ContinuousPrior,
    SceneCode,
    decode_rotations,
    encode_rotations,
)
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingTorchRLEnv, DenoisingVectorEnv
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

CODED = ("quaternion", "axis_angle")


def _rotations() -> Rotation:
    """Random ones, half turns about axes and diagonals, nearly half turns, tiny ones, none, and gimbal-locked ones."""
    axes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [-1, 0, 1], [0, -1, -1], [1, -2, 3], [-3, 1, 0.5]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    turns = [Rotation.from_rotvec(axes * angle) for angle in (np.pi, np.pi - 1e-7, np.pi - 1e-3, 1e-8, 1e-4, np.pi / 2)]
    locked = Rotation.from_euler("xyz", [[a, np.pi / 2, b] for a in (0.3, -2.0, np.pi) for b in (0.1, 3.0)])
    return Rotation.concatenate([Rotation.random(500, rng=0), *turns, Rotation.identity(1), locked])


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_round_trips_keep_every_rotation(rotation: str) -> None:
    matrices = torch.from_numpy(_rotations().as_matrix())
    code = encode_rotations(matrices, rotation)
    assert code.shape == (len(matrices), ROTATION_WIDTHS[rotation])
    torch.testing.assert_close(decode_rotations(code, rotation), matrices, atol=1e-6, rtol=0)
    single = decode_rotations(encode_rotations(matrices.float(), rotation), rotation)
    torch.testing.assert_close(single, matrices.float(), atol=1e-6, rtol=0)


def test_codes_are_those_of_scipy() -> None:
    """Up to the sign of half turns, which only we fix by their axis."""
    rotations = _rotations()
    matrices = torch.from_numpy(rotations.as_matrix())
    quaternion = encode_rotations(matrices, "quaternion").numpy()
    expected = rotations.as_quat(canonical=True, scalar_first=True)
    assert np.abs(np.abs((quaternion * expected).sum(axis=1)) - 1).max() < 1e-6
    clear = np.abs(expected[:, 0]) > 1e-5
    np.testing.assert_allclose(quaternion[clear], expected[clear], atol=1e-6)
    vector = encode_rotations(matrices, "axis_angle").numpy()
    np.testing.assert_allclose(vector[clear], rotations.as_rotvec()[clear], atol=1e-6)
    np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), matrices.numpy(), atol=1e-6)


def test_half_turns_have_one_code_whatever_the_rounding() -> None:
    yaw = torch.tensor([torch.pi, -torch.pi, torch.pi - 1e-7, torch.pi + 1e-7], dtype=torch.float64)
    matrices = torch.from_numpy(Rotation.from_euler("z", yaw.numpy()[:, None]).as_matrix())
    for rotation, last in (("quaternion", 1.0), ("axis_angle", torch.pi)):
        code = encode_rotations(matrices, rotation)
        torch.testing.assert_close(code[:, -1], torch.full((4,), last, dtype=torch.float64), atol=1e-6, rtol=0)


@pytest.mark.parametrize("rotation", ROTATIONS)
def test_any_numbers_decode_to_a_rotation(rotation: str) -> None:
    code = 3.0 * torch.randn(200, ROTATION_WIDTHS[rotation], generator=torch.Generator().manual_seed(0))
    code[0] = 0.0
    matrices = decode_rotations(code, rotation).double()
    unit = matrices @ matrices.transpose(-1, -2)
    torch.testing.assert_close(unit, torch.eye(3, dtype=torch.float64).expand(200, 3, 3), atol=1e-5, rtol=0)
    assert (torch.linalg.det(matrices) > 0.99).all()


def test_an_unknown_representation_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'quaternion'"):
        SceneCode(get_scene_type("dimsum_table"), "quaternions", tiny_prior().normalizer)


@pytest.mark.parametrize(("tilts", "constant"), [(False, [1, 2]), (True, [])])
def test_only_components_that_never_vary_are_constant(tilts: bool, constant: list[int]) -> None:
    base = tiny_prior().normalizer
    low, high = base.input_min.clone(), base.input_max.clone()
    if tilts:
        low[3:12], high[3:12] = -1.0, 1.0
    code = SceneCode(get_scene_type("dimsum_table"), "quaternion", Normalizer.from_range(low, high))
    assert torch.nonzero(code.normalizer.is_constant[3:7]).flatten().tolist() == constant
    code = SceneCode(get_scene_type("dimsum_table"), "axis_angle", Normalizer.from_range(low, high))
    assert torch.nonzero(code.normalizer.is_constant[3:6]).flatten().tolist() == [i - 1 for i in constant]


# -- priors ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)


def _prior(rotation: str, scenes: SceneBatch, network: str = "flux") -> ContinuousPrior:
    base = tiny_prior()
    assert isinstance(base, ContinuousPrior)
    features = 3 + ROTATION_WIDTHS[rotation] + 8
    size = network_config(network, "continuous", features=features, categories=8, hidden=32, depth=2, heads=2)
    config = replace(base.config, network=size, rotation=rotation)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        code = SceneCode(base.scene_type, rotation, base.normalizer)
        prior = ContinuousPrior(config, base.normalizer, Preconditioning.fit(code.encode(scenes)[:, 1:]))
        for parameter in prior.parameters():
            if not bool(parameter.any()):
                torch.nn.init.normal_(parameter, std=0.02)
    return prior.eval()


@pytest.fixture(scope="module", params=ROTATIONS)
def prior(request: pytest.FixtureRequest, scenes: SceneBatch) -> ContinuousPrior:
    return _prior(request.param, scenes)


def _are_rotations(batch: SceneBatch) -> None:
    rotations = batch.rotations[~batch.is_empty].double()
    unit = rotations @ rotations.transpose(-1, -2)
    torch.testing.assert_close(unit, torch.eye(3, dtype=torch.float64).expand_as(unit), atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotations) > 0.99).all()


def test_scenes_survive_encoding(prior: ContinuousPrior, scenes: SceneBatch) -> None:
    x = prior.encode(scenes)
    assert x.shape == (6, 34, prior.features)
    torch.testing.assert_close(prior.decode(x).tensor, scenes.tensor, atol=2e-6, rtol=0)


def test_samples_are_scenes_with_their_table(prior: ContinuousPrior) -> None:
    for slots in (None, 40):
        batch = prior.sample(3, num_steps=4, slots=slots, seed=1)
        assert batch.tensor.shape == (3, slots or 34, 20)
        assert (batch.translations[:, 0] == 0).all()
        torch.testing.assert_close(batch.rotations[:, 0], torch.eye(3).expand(3, 3, 3), atol=1e-6, rtol=0)
        _are_rotations(batch)
        up = batch.rotations[~batch.is_empty][:, 2, 2].abs()
        torch.testing.assert_close(up, torch.ones_like(up))  # nothing tilts in this scene type


def test_known_entries_stay_through_the_chain(prior: ContinuousPrior) -> None:
    table = prior.step_table(3)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    known = prior.known(34)
    assert known[0].all()
    assert int(known[1].sum()) == {"matrix": 4, "quaternion": 2, "axis_angle": 2}[prior.config.rotation]
    for step in range(3):
        after = prior.transition(x, step, table).from_noise(torch.randn(x.shape))
        assert torch.equal(after[:, known], x[:, known])
        x = after


def test_completion_rearrangement_and_inpainting(prior: ContinuousPrior, scenes: SceneBatch) -> None:
    fuller = prior.complete(scenes, slots=40, num_steps=3)
    kept = ~scenes.is_empty
    assert torch.equal(fuller.tensor[:, :34][kept], scenes.tensor[kept])
    moved = prior.rearrange(scenes, num_steps=3)
    assert torch.equal(moved.categories, scenes.categories)
    assert not torch.equal(moved.tensor, scenes.tensor)
    mask = torch.zeros(6, 34, 2, dtype=torch.bool)
    mask[:, 1:4, 0] = mask[:, 3:6, 1] = True
    changed = prior.inpaint(scenes, mask, num_steps=3)
    untouched = ~mask.any(dim=-1)
    assert torch.equal(changed.tensor[untouched], scenes.tensor[untouched])
    for batch in (fuller, moved, changed):
        _are_rotations(batch)


def test_the_loss_and_the_residual_are_of_the_own_width(prior: ContinuousPrior, scenes: SceneBatch) -> None:
    x0 = prior.encode(scenes)
    per_scene = prior.pretraining_loss(x0, torch.Generator().manual_seed(0), "none")
    assert per_scene.shape == (6,)
    assert torch.isfinite(per_scene).all()
    per_scene.mean().backward()
    assert all(parameter.grad is not None for parameter in prior.parameters())
    prior.zero_grad()
    weight = prior.loss_weight(34)
    assert weight.shape == (34, prior.features)
    assert (weight[prior.known(34)] == 0).all()
    residual = prior.fit_residual(x0, levels=3)
    assert residual.variance.shape == (3, prior.features)
    prior.residual = None


def test_files_keep_the_representation(prior: ContinuousPrior, tmp_path: Path) -> None:
    loaded = ScenePrior.load(prior.save(tmp_path))
    assert loaded.config.rotation == prior.config.rotation
    assert torch.equal(loaded.sample(2, num_steps=3).tensor, prior.sample(2, num_steps=3).tensor)


@pytest.mark.parametrize("network", ["midiffusion", "diffuscene"])
def test_other_networks_denoise_and_come_back_from_files(network: str, scenes: SceneBatch, tmp_path: Path) -> None:
    prior = _prior("quaternion", scenes, network)
    loaded = ScenePrior.load(prior.save(tmp_path))
    assert type(loaded.denoiser.network) is type(prior.denoiser.network)
    assert torch.equal(loaded.sample(1, num_steps=2).tensor, prior.sample(1, num_steps=2).tensor)


@pytest.mark.parametrize("rotation", CODED)
def test_policies_draw_and_score_steps(rotation: str, scenes: SceneBatch) -> None:
    prior = _prior(rotation, scenes)
    policy = DenoisingPolicy(prior, 4)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    action, log_prob = policy.draw(x, 0, torch.Generator().manual_seed(1))
    step = prior.transition(x, 0, policy.table)
    assert isinstance(step, GaussianStep)
    expected = gaussian_log_prob(action, step.mean, step.std)
    torch.testing.assert_close(log_prob, expected)
    torch.testing.assert_close(policy.log_prob(x, 0, action), expected)
    assert policy.random_entries(34) == int((~prior.known(34)).sum())


@pytest.mark.parametrize("rotation", CODED)
def test_environments_are_of_the_prior_s_width(rotation: str, scenes: SceneBatch) -> None:
    prior = _prior(rotation, scenes)
    env = DenoisingVectorEnv(2, prior=prior, reward="object_count", num_steps=3, action_mode="noise")
    observation, _ = env.reset(seed=0)
    assert observation["scene"].shape == (2, 34, prior.features)
    table, x = prior.step_table(3), torch.from_numpy(observation["scene"])
    rng = np.random.default_rng(0)
    for step in range(3):
        noise = rng.standard_normal(x.shape).astype(np.float32)
        x = prior.transition(x, step, table).from_noise(torch.from_numpy(noise)).clamp(-10, 10)
        if step < 2:
            observation = env.step(noise)[0]
            torch.testing.assert_close(torch.from_numpy(observation["scene"]), x)
    expected = prior.decode(x)
    _, _, terminated, _, info = env.step(noise)
    assert terminated.all()
    assert info["final_info"]["objects"].tolist() == expected.counts.tolist()


@pytest.mark.parametrize("rotation", CODED)
def test_post_training_takes_them(rotation: str, scenes: SceneBatch) -> None:
    prior = _prior(rotation, scenes)
    policy = DenoisingPolicy(prior, 3)
    rollout = collect(DenoisingTorchRLEnv(2, prior=prior, reward="object_count", num_steps=3), policy, seed=0)
    result = DDPOSFLoss(policy)(rollout[:, 0].set("advantage", torch.tensor([1.0, -1.0])))
    assert float(result["log_ratio"]) < 1e-4
    result["loss_objective"].backward()
    head = prior.denoiser.network.out.weight.grad
    assert head is not None
    assert torch.isfinite(head).all()
    assert float(head.norm()) > 0


def test_networks_that_do_not_fit_are_named() -> None:
    base = tiny_prior()
    assert isinstance(base, ContinuousPrior)
    keys = (base.normalizer, base.preconditioning)
    with pytest.raises(InvalidInputError, match=r"rotation='quaternion' have 15; build it with features=15"):
        ContinuousPrior(replace(base.config, rotation="quaternion"), *keys)
    with pytest.raises(InvalidInputError, match="MixedFluxConfig is not the configuration of a continuous network"):
        ContinuousPrior(replace(base.config, network=MixedFluxConfig(8, hidden=32, heads=2)), *keys)  # type: ignore[arg-type]
    with pytest.raises(UnknownNameError, match="did you mean 'axis_angle'"):
        ContinuousPrior(replace(base.config, rotation="axisangle", network=FluxConfig(14)), *keys)
