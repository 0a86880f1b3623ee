"""Relations of pairs of slots, contacts between objects, and features of noisy poses that the mixed network reads."""

from __future__ import annotations

import math
from typing import Any

import pytest
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from agents.networks import MixedFlux, MixedFluxConfig, build_network
from agents.networks.flux_modules import FourierFeaturesConfig, ModuleConfig
from agents.networks.geometry import (
    CHANNELS,
    PAIR_FEATURES,
    Contacts,
    ContactsConfig,
    Relations,
    RelationsConfig,
    RotationFeaturesConfig,
    gated_displacement,
    joint_attention,
    nearest_rotations,
    pair_features,
    rotation_features,
)
from scene_envs.errors import InvalidInputError, UnknownNameError

SCALES = torch.logspace(-2, 0, 8, dtype=torch.float64)


def _scene(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    metres = torch.rand(2, 6, 3, generator=generator, dtype=torch.float64)
    return metres, 0.1 * torch.rand(2, 6, 1, generator=generator, dtype=torch.float64).expand(-1, -1, 3)


def test_only_offsets_count_and_turning_the_scene_turns_the_directions() -> None:
    metres, noise = _scene()
    features = pair_features(metres, noise, SCALES)
    moved = pair_features(metres + torch.tensor([3.0, -1.0, 0.5]).double(), noise, SCALES)
    torch.testing.assert_close(moved, features)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    turned = pair_features(metres @ turn.T, noise, SCALES)
    torch.testing.assert_close(turned[..., :24], features[..., :24])
    directions = features[..., 24:].unflatten(-1, (2, 8))
    torch.testing.assert_close(
        turned[..., 24:].unflatten(-1, (2, 8)), torch.einsum("ij,...jk", turn[:2, :2], directions)
    )


def test_blurred_distances_are_expectations_under_the_noise_of_their_axes() -> None:
    """E exp(-d^2 / 2 l^2) of an offset under noise of variance s^2 is l / sqrt(l^2 + s^2) of the feature, per axis."""
    generator = torch.Generator().manual_seed(1)
    metres = torch.tensor([[[0.0, 0.0, 0.0], [0.2, -0.1, 0.3]]], dtype=torch.float64)
    noise = torch.tensor([[[0.3, 0.1, 0.1], [0.4, 0.1, 0.2]]], dtype=torch.float64)
    variance = noise.square().sum(dim=1)[0]
    features = pair_features(metres, noise, SCALES)[0, 0, 1]
    drawn = metres[0, 1] + torch.randn(400_000, 3, generator=generator, dtype=torch.float64) * variance.sqrt()
    factors = SCALES / (SCALES**2 + variance[:, None]).sqrt()  # (3, 8)
    height = torch.exp(-0.5 * drawn[:, 2:] ** 2 / SCALES**2).mean(dim=0)
    torch.testing.assert_close(features[8:16] * factors[2], height, atol=2e-3, rtol=0)
    across = torch.exp(-0.5 * drawn[:, :2].square().sum(dim=-1, keepdim=True) / SCALES**2).mean(dim=0)
    torch.testing.assert_close(features[:8] * factors[:2].prod(dim=0), across, atol=2e-3, rtol=0)


def test_a_low_axis_is_blurred_by_its_own_noise() -> None:
    """In a room of 5 m by 0.5 m noise of 0.02 is 1 cm in height, which leaves 2 cm visible; 10 cm would not."""
    position, noise = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.04]]]), torch.full((1, 2), 0.02)
    for blur, metres in (("axis", 0.01), ("largest", 0.1)):
        height = Relations(1, 2, (5.0, 5.0, 0.5), blur=blur)(position, noise)[1][0, 0, 1, 8]
        assert float(height) == pytest.approx(math.exp(-0.5 * 0.02**2 / (2 * metres**2 + 0.01**2)), rel=1e-5)
    with pytest.raises(UnknownNameError, match="axis"):
        RelationsConfig(blur="axes")


def test_messages_are_weighted_means_of_the_features() -> None:
    """With flat logits every slot gathers the mean of its features; text tokens gather nothing."""
    heads, width, text, slots = 2, 4, 3, 5
    features = torch.rand(1, slots, slots, PAIR_FEATURES)
    zeros = torch.zeros(1, heads, text + slots, width)
    mask = torch.zeros(1, heads, text + slots, text + slots)
    mask[..., :text] = -torch.inf
    gathered = nn.Linear(heads * PAIR_FEATURES, heads * width, bias=False)
    found = joint_attention(zeros, zeros, zeros, mask, features, gathered)
    mean = features.mean(dim=2).repeat(1, 1, heads)
    torch.testing.assert_close(found[:, text:], gathered(mean))
    assert not found[:, :text].any()


def test_relations_know_the_unit_of_every_axis() -> None:
    """A scene half as large in units twice as large is the same scene; an axis that never varies does not count."""
    position, noise = torch.rand(1, 4, 3), torch.rand(1, 4)
    small = Relations(1, 2, (1.0, 1.0, 0.0))
    large = Relations(1, 2, (2.0, 2.0, 0.0))
    large.load_state_dict(small.state_dict())
    large.scales.copy_(small.scales)
    for a, b in zip(small(position, noise), large(position / 2, noise / 2), strict=True):
        torch.testing.assert_close(a, b)
    flat = position.clone()
    flat[..., 2] = 0.0
    torch.testing.assert_close(small(position, noise)[1], small(flat, noise)[1])


MODULES = (RelationsConfig(), ContactsConfig())
SIDEWAYS, HEIGHT, OWN, OTHERS = 0, 1, slice(2, 5), slice(5, 8)
REACH, TOUCH = 4.0, 0.1
IDENTITY = torch.eye(3, dtype=torch.float64)


def linear_along(*gaps: int | slice) -> Contacts:
    """Everything touches at 0.1 m, and all that is offered is each of these gaps, linearly, along itself."""
    torch.manual_seed(0)
    contacts = Contacts(categories=3, features=4, hidden=8, embedding=8).double()
    for layer in (contacts.touch[-1], contacts.amplitudes):
        for parameter in layer.parameters():
            nn.init.zeros_(parameter)
    bias = contacts.amplitudes.bias.data.view(2, CHANNELS, 8)
    for gap in gaps:
        bias[1, 0, gap] = -1.0
    return contacts


def displacement(
    contacts: Contacts, metres: Tensor, noise: float | list[float], rotation: Tensor | None = None
) -> Tensor:
    """(N, 3) of the first channel, for objects at ``metres`` (N, 3)."""
    count = len(metres)
    turned = IDENTITY.expand(1, count, 3, 3) if rotation is None else rotation[None]
    level = torch.as_tensor(noise, dtype=torch.float64).expand(1, count, 3)
    features = torch.zeros(1, count, count, 4, dtype=torch.float64)
    return contacts(metres[None], turned, torch.zeros(1, count).long(), level, features)[1][0, :, 0].detach()


def share(noise: float) -> float:
    return math.sqrt(2) * noise / math.hypot(math.sqrt(2) * noise, 2e-4)


def bounded(gap: float, noise: float) -> float:
    gap /= math.hypot(math.sqrt(2) * noise, 2e-4)
    return gap / math.sqrt(1 + (gap / REACH) ** 2)


@pytest.mark.parametrize("noise", [1e-3, 0.01])
@pytest.mark.parametrize("distance", [0.095, 0.099, 0.1, 0.102])
def test_two_objects_part_by_their_gap_in_units_of_the_noise(noise: float, distance: float) -> None:
    direction = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64)
    first, second = displacement(linear_along(SIDEWAYS), torch.stack([0 * direction, distance * direction]), noise)
    torch.testing.assert_close(second, -first)
    sharpness = (
        share(noise) * distance / math.hypot(distance, math.sqrt(2) * noise, 2e-4)
    )  # the direction itself is noisy
    wanted = -bounded(distance - TOUCH, noise) * sharpness * direction
    torch.testing.assert_close(second, wanted, atol=1e-4, rtol=1e-4)


def test_what_stands_on_something_is_moved_in_height_alone() -> None:
    metres = torch.tensor([[0.0, 0.0, 0.0], [0.01, 0.0, 0.103]], dtype=torch.float64)
    below, above = displacement(linear_along(HEIGHT), metres, 1e-3)
    assert above.tolist()[:2] == [0.0, 0.0]
    assert float(above[2]) == pytest.approx(-share(1e-3) * bounded(0.003, 1e-3), rel=1e-3)
    torch.testing.assert_close(below, -above)


def test_boxes_part_along_their_own_axes() -> None:
    """The second stands 99 mm along the first one's x-axis, and 50 mm along its y-axis; both axes are moved along."""
    turn = torch.from_numpy(Rotation.from_euler("z", 0.4).as_matrix())
    inside = torch.tensor([0.099, 0.05, 0.0], dtype=torch.float64)
    metres = torch.stack([torch.zeros(3, dtype=torch.float64), turn @ inside])
    rotation = torch.stack([turn, IDENTITY])
    contacts = linear_along(OWN.start)
    first, _ = displacement(contacts, metres, 1e-3, rotation)
    away = -share(1e-3) * bounded(-0.001, 1e-3) * turn[:, 0]
    torch.testing.assert_close(first, -away, atol=1e-3, rtol=1e-3)
    _, second = displacement(linear_along(OTHERS.start), metres, 1e-3, rotation)
    torch.testing.assert_close(second, away, atol=1e-3, rtol=1e-3)


def test_noise_that_differs_by_axis_moves_most_along_the_noisiest() -> None:
    """Given that two objects touch, the mean of the noise along x is its covariance with the gap over its variance."""
    direction, noise = torch.tensor([0.6, 0.8, 0.0], dtype=torch.float64), [0.01, 0.002, 0.05]
    covariance = torch.tensor(noise, dtype=torch.float64).square()
    along = float(2 * (covariance * direction.square()).sum() + 4e-8)
    distance, gap = 0.101, 0.001
    second = displacement(linear_along(SIDEWAYS), torch.stack([0 * direction, distance * direction]), noise)[1]
    shift = -2 * covariance * direction * gap / along / torch.tensor(noise)  # of both together, in units of the noise
    sharpness = distance / math.hypot(distance, math.sqrt(along))
    torch.testing.assert_close(second, shift * sharpness / math.sqrt(2), atol=1e-4, rtol=1e-2)


def test_what_is_offered_turns_with_the_scene() -> None:
    turn = torch.from_numpy(Rotation.from_euler("z", 1.1).as_matrix())
    generator = torch.Generator().manual_seed(3)
    metres = 0.1 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    rotation = torch.from_numpy(Rotation.random(5, random_state=4).as_matrix())
    torch.manual_seed(1)
    contacts = Contacts(categories=3, features=4, hidden=8, embedding=8).double()
    before = displacement(contacts, metres, 0.01, rotation)
    after = displacement(contacts, metres @ turn.T, 0.01, turn @ rotation)
    torch.testing.assert_close(after, before @ turn.T, atol=1e-9, rtol=1e-9)


def test_an_object_alone_and_filling_offer_nothing() -> None:
    torch.manual_seed(1)
    contacts = Contacts(categories=3, features=4, hidden=8, embedding=8).double()
    nn.init.normal_(contacts.out.weight)
    assert displacement(contacts, torch.zeros(1, 3, dtype=torch.float64), 0.1).tolist() == [[0.0, 0.0, 0.0]]
    level, features = torch.full((1, 2, 3), 0.1).double(), torch.zeros(1, 2, 2, 4).double()
    states, turned = torch.zeros(1, 2).long(), IDENTITY.expand(1, 2, 3, 3)
    metres = torch.tensor([[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]], dtype=torch.float64)
    only_first = torch.tensor([[True, False]])
    messages, moves = contacts(metres, turned, states, level, features, only_first)
    assert moves[0, 0].abs().max() == 0
    torch.testing.assert_close(messages[0, 0], contacts.out.bias)


def test_a_masked_slot_is_moved_but_told_nothing() -> None:
    torch.manual_seed(1)
    contacts = Contacts(categories=3, features=4, hidden=8, embedding=8).double()
    nn.init.normal_(contacts.out.weight)
    metres = torch.tensor([[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]], dtype=torch.float64)
    level, features = torch.full((1, 2, 3), 0.1).double(), torch.zeros(1, 2, 2, 4).double()
    states = torch.tensor([[0, 3]])  # 3 = K is the mask token
    messages, moves = contacts(metres, IDENTITY.expand(1, 2, 3, 3), states, level, features)
    assert messages[0, 1].abs().max() == 0
    assert messages[0, 0].abs().max() > 0
    assert moves[0, 1].abs().max() > 0


def test_gates_weigh_every_displacement_by_itself() -> None:
    offered = torch.randn(2, 3, CHANNELS, 3, generator=torch.Generator().manual_seed(0))
    gates = torch.zeros(2, 3, 3 * CHANNELS)
    assert gated_displacement(offered, gates).abs().max() == 0
    gates[0, 1, 3 * 2 + 1] = 0.5  # channel 2 along y
    added = gated_displacement(offered, gates)
    assert float(added[0, 1, 1]) == pytest.approx(0.5 * float(offered[0, 1, 2, 1]))
    assert int((added != 0).sum()) == 1


def test_a_network_with_contacts_starts_at_the_mean_like_any_other() -> None:
    config = MixedFluxConfig(categories=5, hidden=16, heads=2, embedding=16, modules=MODULES)
    network = build_network(config)
    pose = torch.randn(2, 4, 12)
    output, logits = network(
        pose, torch.zeros(2, 4).long(), torch.zeros(2), position=pose, noise_level=torch.full((2, 4), 0.3)
    )
    assert output.abs().max() == 0
    assert logits.abs().max() == 0
    output.sum().backward()
    assert network.contacts.gates.weight.grad.abs().max() > 0


def test_numbers_that_are_none_stay_with_their_scene() -> None:
    torch.manual_seed(1)
    contacts = Contacts(categories=3, features=4, hidden=8, embedding=8).double()
    metres = torch.randn(2, 3, 3, dtype=torch.float64)
    metres[1, 0, 0] = math.nan
    level, features = torch.full((2, 3, 3), 0.1).double(), torch.zeros(2, 3, 3, 4).double()
    _, moves = contacts(metres, IDENTITY.expand(2, 3, 3, 3), torch.zeros(2, 3).long(), level, features)
    assert not moves[0].isnan().any()
    assert moves[1].isnan().any()


def test_half_precision_of_the_network_leaves_contacts_exact() -> None:
    """bfloat16 knows a metre to four millimetres."""
    torch.manual_seed(0)
    config = MixedFluxConfig(categories=5, hidden=16, heads=2, embedding=16, modules=MODULES)
    network = build_network(config)
    told: list[Tensor] = []
    network.contacts.register_forward_hook(lambda module, given, out: told.append(out[1].detach()))
    position = torch.cat([torch.randn(2, 6, 3), torch.eye(3).flatten().expand(2, 6, 9)], dim=-1)
    inputs = {"position": position, "noise_level": torch.full((2, 6), 1e-3)}
    for precision in (torch.float32, torch.bfloat16):
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=precision == torch.bfloat16):
            network(position, torch.zeros(2, 6).long(), torch.zeros(2), **inputs)
    torch.testing.assert_close(told[1], told[0])


def test_noise_without_end_moves_nothing_without_end() -> None:
    """Noisy matrices are no rotations: what is made of their axes would grow with the noise."""
    torch.manual_seed(0)
    config = MixedFluxConfig(categories=5, hidden=16, heads=2, embedding=16, modules=MODULES)
    network = build_network(config)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.2)
    noise = torch.randn(8, 6, 12)
    exact = torch.cat([0.1 * torch.randn(8, 6, 3), torch.eye(3).flatten().expand(8, 6, 9)], dim=-1)
    sizes = []
    for level in (0.1, 20.0, 1000.0):
        position = exact + level * noise
        told = {"position": position, "noise_level": torch.full((8, 6), level)}
        output, _ = network(position / math.hypot(1, level), torch.zeros(8, 6).long(), torch.zeros(8), **told)
        sizes.append(float(output.detach()[..., :3].abs().mean()))
    assert max(sizes) < 3 * sizes[0]


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
    noisy = place + level * torch.randn(20_000, 1, 3, generator=generator)
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
