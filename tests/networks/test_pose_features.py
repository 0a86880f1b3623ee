"""Features of noisy poses that the mixed network reads beside the poses themselves."""

from __future__ import annotations

import math
from typing import Any

import pytest
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from agents.networks import MixedFlux, MixedFluxConfig
from agents.networks.flux_modules import FourierFeaturesConfig, ModuleConfig
from agents.networks.geometry import RotationFeaturesConfig, nearest_rotations, rotation_features
from scene_envs.errors import InvalidInputError


def network(*modules: ModuleConfig, **fields: Any) -> MixedFlux:
    torch.manual_seed(0)
    return MixedFlux(MixedFluxConfig(categories=5, hidden=16, heads=2, modules=modules, **fields))


def arguments(position: Tensor, level: float = 0.0) -> dict[str, Any]:
    scenes, slots = position.shape[:2]
    return {
        "pose": torch.zeros(scenes, slots, 12),
        "states": torch.zeros(scenes, slots, dtype=torch.int64),
        "time": torch.zeros(scenes),
        "position": position,
        "noise_level": torch.full((scenes, slots), level),
    }


def first_layer_input(made: MixedFlux, position: Tensor, level: float) -> Tensor:
    """What the first layer is given beside the pose itself, (B, N, features)."""
    seen: list[Tensor] = []
    handle = made.pose_in[0].register_forward_pre_hook(lambda _, given: seen.append(given[0]))
    made(**arguments(position, level))
    handle.remove()
    return seen[0][..., 12:]


def turns(count: int, seed: int = 0) -> Tensor:
    """Random rotation matrices (1, count, 3, 3), float64."""
    return torch.from_numpy(Rotation.random(count, random_state=seed).as_matrix())[None]


@pytest.mark.slow
@pytest.mark.parametrize("level", [0.01, 0.1, 0.5])
def test_features_of_a_position_are_the_mean_of_those_of_noisy_ones(level: float) -> None:
    """E sin(w (x + s n)) = sin(w x) exp(-w^2 s^2 / 2): a wave that noise blurs is as faint as it is unknown."""
    made = network(FourierFeaturesConfig(3))
    generator = torch.Generator().manual_seed(1)
    place = torch.rand(1, 1, 3, generator=generator) * 2 - 1
    noisy = place + level * torch.randn(40_000, 1, 3, generator=generator)
    angle = place[..., None] * math.pi * 2.0 ** torch.arange(3)
    waves = torch.cat([angle.sin().flatten(-2), angle.cos().flatten(-2)], dim=-1)
    torch.testing.assert_close(first_layer_input(made, place, 0.0), waves)
    mean = first_layer_input(made, noisy, 0.0).mean(dim=0)
    torch.testing.assert_close(first_layer_input(made, place, level)[0], mean, atol=0.02, rtol=0)


@pytest.mark.parametrize("level", [1e-3, 0.03, 0.3])
def test_what_is_off_so3_is_the_noise_but_for_the_turn_that_it_makes(level: float) -> None:
    """The residual is that of the polar factor; of nine numbers of unit noise six are off SO(3), for small noise."""
    exact = turns(2000)
    noise = torch.randn(exact.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    noisy = exact + level * noise
    off = rotation_features(noisy, nearest_rotations(noisy), torch.full(exact.shape[:2], level, dtype=torch.float64))[
        ..., :9
    ]
    for number in range(5):
        nearest, _ = scipy.linalg.polar(noisy[0, number].numpy())
        wanted = (noisy[0, number] - torch.from_numpy(nearest)) / level
        torch.testing.assert_close(off[0, number], wanted.flatten(), atol=1e-9, rtol=0)
    if level < 0.1:
        assert float(off.square().mean()) == pytest.approx(6 / 9, rel=0.05)


def test_tilt_is_told_in_units_of_the_noise_and_yaw_is_not() -> None:
    yaw = Rotation.from_euler("z", [[0.3], [2.0], [-1.0]])
    for degrees in (0.0, 0.05, 0.5, 90.0):
        tilted = torch.from_numpy((Rotation.from_euler("x", degrees, degrees=True) * yaw).as_matrix())[None]
        row = rotation_features(tilted, nearest_rotations(tilted), torch.full((1, 3), 0.01).double())[0, :, 9:11].norm(
            dim=-1
        )
        sine = math.sin(math.radians(degrees)) / 0.01
        if degrees < 1:
            assert row.tolist() == pytest.approx([sine] * 3, rel=0.05, abs=1e-9)
        else:  # far from upright it saturates
            assert bool((row <= 4 * math.sqrt(2)).all() and (row > 3.9).all())


def test_a_milliradian_is_seen_through_features_of_rotations_alone() -> None:
    """Of two objects with the same numbers on the scale of the noise, one is turned by 0.001 about x."""
    flat = torch.cat([torch.zeros(3), torch.eye(3).flatten()]).expand(1, 2, 12).clone()
    tilted = flat.clone()
    tilted[0, 1, 8], tilted[0, 1, 10] = -1e-3, 1e-3
    waves = FourierFeaturesConfig()
    for used, modules in enumerate([(waves,), (waves, RotationFeaturesConfig())]):
        made = network(*modules)
        change = first_layer_input(made, tilted, 1e-3) - first_layer_input(made, flat, 1e-3)
        assert float(change.abs().max()) == pytest.approx(used, abs=0.05)


def test_rotations_are_read_in_normalised_units() -> None:
    """Matrices that are normalised to another range are the same matrices."""
    exact = turns(4).float().flatten(-2)
    places = torch.zeros(1, 4, 3)
    plain = network(RotationFeaturesConfig())
    scaled = network(RotationFeaturesConfig(), rotations=((0.5,) * 9, (0.25,) * 9))
    same = torch.cat([places, (exact - 0.25) / 0.5], dim=-1)
    wanted = first_layer_input(plain, torch.cat([places, exact], dim=-1), 0.05)[..., -13:]
    torch.testing.assert_close(first_layer_input(scaled, same, 0.1)[..., -13:], wanted, atol=1e-4, rtol=0)


def test_features_of_poses_need_poses() -> None:
    made = network(RotationFeaturesConfig())
    with pytest.raises(InvalidInputError, match="rotation_features needs position="):
        made(**{**arguments(torch.zeros(1, 2, 12)), "position": None})


def test_numbers_that_are_none_pass_through() -> None:
    """A network that diverged makes no number; the chain reports it, not a decomposition."""
    broken = turns(2).clone()
    broken[0, 1, 0, 0] = math.nan
    features = rotation_features(broken, nearest_rotations(broken), torch.full((1, 2), 0.1).double())
    assert not features[0, 0].isnan().any()
    assert features[0, 1].isnan().any()
