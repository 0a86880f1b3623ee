"""Classifier two-sample test: near chance on equal distributions, above it where scenes differ."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from agents.evaluation import grammar_scenes
from agents.evaluation.classifier import Accuracy, ClassifierConfig, classifier_accuracy
from agents.evaluation.set_network import SetNetwork, SetNetworkConfig, blurred, scene_tokens
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.fake_gpu import fake_gpu

QUICK = ClassifierConfig(epochs=8, patience=4, batch_size=16)


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return grammar_scenes("dimsum_table", 160, seed=4)


def lifted(batch: SceneBatch, by: float) -> SceneBatch:
    """All free objects ``by`` metres higher."""
    translations = batch.translations.clone()
    translations[..., 2] += by * batch.is_free
    return batch.with_poses(translations, batch.rotations)


def two_cups(distance: float) -> SceneBatch:
    """A table with two cups, ``distance`` metres apart along x."""
    batch = SceneBatch.empty("dimsum_table", 1)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    translations[0, 2, 0] = distance
    rotations[0, 1:3] = torch.eye(3)
    categories[0, 1:3] = batch.scene_type.assets.index("teacup")
    return SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)


@pytest.mark.slow
def test_real_against_real_is_chance(scenes: SceneBatch) -> None:
    accuracy = classifier_accuracy(scenes[:80], scenes[80:], seeds=1, config=QUICK)
    assert accuracy.mean == pytest.approx(0.5, abs=0.27)  # 56 held-out scenes: 7 % standard error


@pytest.mark.slow
def test_scenes_five_millimetres_too_high_are_found_out(scenes: SceneBatch) -> None:
    accuracy = classifier_accuracy(scenes[:80], lifted(scenes[80:], 5e-3), seeds=1, config=QUICK)
    assert accuracy.mean > 0.9


def test_the_same_seed_gives_the_same_accuracy_and_leaves_torch_alone(scenes: SceneBatch) -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    short = ClassifierConfig(epochs=1)
    first, again = (classifier_accuracy(scenes[:40], scenes[40:80], seeds=2, config=short) for _ in range(2))
    assert first == again
    assert len(first.per_seed) == 2
    assert torch.equal(torch.rand(3), expected)


def test_scenes_of_two_devices_are_compared(scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    short = ClassifierConfig(epochs=1)
    expected = classifier_accuracy(scenes[:24], scenes[24:48], seeds=1, config=short)
    with fake_gpu(monkeypatch):
        assert classifier_accuracy(scenes[:24], scenes[24:48].to("cuda"), seeds=1, config=short) == expected


def test_accuracy_summarises_its_seeds() -> None:
    values = [0.4, 0.55, 0.7]
    accuracy = Accuracy.of(values)
    assert accuracy.mean == pytest.approx(np.mean(values))
    assert accuracy.std == pytest.approx(np.std(values))


def test_tokens_hold_what_is_there_and_how_near_it_is() -> None:
    batch = two_cups(0.2)
    cup = batch.scene_type.library["teacup"].bounds
    tokens = scene_tokens(batch, neighbours=2)
    assert tokens.present.tolist() == [[True] * 3]
    first = tokens.offsets[0, 1]  # of the first cup: the table touches it, the other cup is the second nearest
    assert tokens.neighbours[0, 1].tolist() == [batch.scene_type.assets.index(n) for n in ("cafe_table", "teacup")]
    assert float(first[1, 0].sinh() * 0.1) == pytest.approx(0.2, abs=1e-6)
    width = float(cup[1, 0] - cup[0, 0])
    assert float(first[1, 3].sinh() * 5e-3) == pytest.approx(0.2 - width, abs=1e-5)


def test_tokens_do_not_depend_on_the_order_of_the_slots(scenes: SceneBatch) -> None:
    batch = scenes[:20]
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    ours, theirs = scene_tokens(batch), scene_tokens(SceneBatch(batch.tensor[:, order], batch.scene_type))
    for name in ("poses", "offsets", "neighbours", "extents"):
        sums = [getattr(tokens, name).double().square().flatten(1).sum(dim=1) for tokens in (ours, theirs)]
        assert torch.allclose(*sums, rtol=1e-9), name


def test_overlapping_boxes_have_a_negative_gap() -> None:
    batch = two_cups(0.02)
    width = float(np.ptp(batch.scene_type.library["teacup"].bounds[:, 0]))
    tokens = scene_tokens(batch, neighbours=1)
    assert float(tokens.offsets[0, 1, 0, 3].sinh() * 5e-3) == pytest.approx(0.02 - width, abs=1e-5)


def test_blur_has_the_size_asked_for(scenes: SceneBatch) -> None:
    moved = blurred(scenes, 1e-3, 1e-2, torch.Generator().manual_seed(0))
    present = ~scenes.is_empty
    shift = (moved.translations - scenes.translations)[present]
    assert float(shift.std()) == pytest.approx(1e-3, rel=0.05)
    turn = moved.rotations[present] @ scenes.rotations[present].transpose(-1, -2)
    vector = torch.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]])
    assert float(0.5 * vector.std()) == pytest.approx(1e-2, rel=0.05)
    assert torch.equal(moved.categories, scenes.categories)


def test_the_network_ignores_order_and_padding() -> None:
    torch.manual_seed(0)
    network = SetNetwork(SetNetworkConfig(features=5, categories=4, outputs=3)).eval()
    own, categories = torch.randn(2, 6, 5), torch.randint(4, (2, 6))
    offsets, neighbours = torch.randn(2, 6, 3, 7), torch.randint(4, (2, 6, 3))
    present = torch.tensor([[True] * 6, [True] * 4 + [False] * 2])
    expected = network(own, categories, offsets, neighbours, present)
    order = torch.randperm(6)
    shuffled = network(own[:, order], categories[:, order], offsets[:, order], neighbours[:, order], present[:, order])
    assert torch.allclose(shuffled, expected, atol=1e-5)
    own[1, 4:], offsets[1, 4:] = 7.0, -3.0
    assert torch.allclose(network(own, categories, offsets, neighbours, present), expected, atol=1e-5)
    assert bool(torch.isfinite(network(own, categories, offsets, neighbours, torch.zeros_like(present))).all())


def test_bad_input_is_refused(scenes: SceneBatch) -> None:
    other = SceneBatch.empty("pantry_shelf", 30)
    with pytest.raises(InvalidInputError, match="'dimsum_table' cannot be compared with scenes of 'pantry_shelf'"):
        classifier_accuracy(scenes, other)
    with pytest.raises(InvalidInputError, match="at least 20 real scenes and samples each, got 160 and 3"):
        classifier_accuracy(scenes, scenes[:3])
    with pytest.raises(InvalidInputError, match="seeds must be at least 1"):
        classifier_accuracy(scenes, scenes, seeds=0)
    with pytest.raises(InvalidInputError, match="neither negative"):
        classifier_accuracy(scenes, scenes, resolution=(-1e-3, 0.0))
    with pytest.raises(InvalidInputError, match="epochs=0 must be at least 1"):
        ClassifierConfig(epochs=0)
