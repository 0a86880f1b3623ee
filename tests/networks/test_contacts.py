"""Pairwise contacts: the gaps between objects that a network reads, and the displacements along them."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from agents.networks import MixedFluxConfig, build_network
from agents.networks.geometry import CHANNELS, Contacts, ContactsConfig, RelationsConfig, gated_displacement

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
