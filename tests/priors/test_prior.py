"""Properties of priors: equivariance, clamping, inpainting, files."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.scene import SceneBatch


@pytest.fixture(scope="module")
def prior() -> ScenePrior:
    return tiny_prior()


def test_the_denoiser_is_permutation_equivariant(prior: ScenePrior) -> None:
    x = torch.randn(3, 34, 20, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([1, 400, 1000])
    order = torch.randperm(34, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(prior.denoiser(x, t)[:, order], prior.denoiser(x[:, order], t), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("num_steps", "slots"), [(50, None), (150, None), (5, 48), (1, 20)])
def test_samples_hold_the_table_and_upright_objects(prior: ScenePrior, num_steps: int, slots: int | None) -> None:
    batch = prior.sample(2, num_steps=num_steps, slots=slots, seed=1)
    assert batch.tensor.shape == (2, slots or 34, 20)
    table = batch.scene_type.assets.index("cafe_table")
    assert batch.categories[:, 0].tolist() == [table, table]
    assert bool((batch.translations[:, 0] == 0).all())
    identity = torch.eye(3).expand(2, 3, 3)
    torch.testing.assert_close(batch.rotations[:, 0], identity)
    up = batch.rotations[~batch.is_empty][:, 2, 2]
    torch.testing.assert_close(up.abs(), torch.ones_like(up))


def test_same_seed_same_scenes(prior: ScenePrior) -> None:
    first, second = (prior.sample(3, num_steps=4, seed=5).tensor for _ in range(2))
    assert torch.equal(first, second)
    assert not torch.equal(first, prior.sample(3, num_steps=4, seed=6).tensor)


def test_the_last_step_is_deterministic_and_known_entries_have_no_noise(prior: ScenePrior) -> None:
    table = prior.step_table(10)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    _, first = prior.posterior(x, 0, table)
    _, last = prior.posterior(x, 9, table)
    assert bool((first[0] == 0).all())
    assert bool((first[1:, :2] > 0).all())
    assert bool((last == 0).all())


def test_inpainting_keeps_the_rest_bit_identical(prior: ScenePrior) -> None:
    batch = prior.sample(3, num_steps=4, seed=2)
    mask = torch.zeros(3, 34, dtype=torch.bool)
    mask[:, 5:12] = True
    changed = prior.inpaint(batch, mask, num_steps=4, seed=9)
    assert torch.equal(changed.tensor[~mask], batch.tensor[~mask])
    assert not torch.equal(changed.tensor[mask], batch.tensor[mask])
    nothing = prior.inpaint(batch, torch.zeros_like(mask), num_steps=4)
    assert torch.equal(nothing.tensor, batch.tensor)


def test_inpainting_noise_belongs_to_the_scene(prior: ScenePrior) -> None:
    """A scene's result does not depend on which scenes share its batch."""
    batch = prior.sample(2, num_steps=4, seed=2)
    mask = torch.ones(2, 34, dtype=torch.bool)
    both = prior.inpaint(batch, mask, num_steps=4, generators=[torch.Generator().manual_seed(s) for s in (3, 4)])
    alone = prior.inpaint(batch[1], mask[1:], num_steps=4, generators=[torch.Generator().manual_seed(4)])
    torch.testing.assert_close(both.tensor[1:], alone.tensor, atol=1e-4, rtol=1e-4)


def test_a_mask_of_the_wrong_shape_is_named(prior: ScenePrior) -> None:
    batch = prior.sample(2, num_steps=2)
    with pytest.raises(InvalidInputError, match=r"\(2, 34\)"):
        prior.inpaint(batch, torch.zeros(2, 3, dtype=torch.bool))


def test_scenes_without_their_table_are_refused(prior: ScenePrior) -> None:
    batch = prior.sample(2, num_steps=2)
    shuffled = SceneBatch(batch.tensor.flip(1), batch.scene_type)
    with pytest.raises(InvalidInputError, match="cafe_table"):
        prior.encode(shuffled)


def test_the_loss_ignores_what_is_known(prior: ScenePrior) -> None:
    """Changing the network's output on the table's slot does not change the loss."""
    weight = prior.loss_weight(34)
    assert bool((weight[0] == 0).all())
    assert bool((weight[:, [5, 8, 9, 10]] == 0).all())  # tilt, constant in this scene type
    assert float(weight[1, 0]) == prior.config.translation_weight * float(weight[1, -1])


def test_save_and_load_round_trip(prior: ScenePrior, tmp_path: Path) -> None:
    prior.save(tmp_path / "mine")
    loaded = ScenePrior.load(tmp_path / "mine")
    assert torch.equal(loaded.sample(2, num_steps=3).tensor, prior.sample(2, num_steps=3).tensor)


def test_truncated_weights_are_a_clear_error(prior: ScenePrior, tmp_path: Path) -> None:
    directory = prior.save(tmp_path / "mine")
    weights = directory / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(CorruptFileError, match="truncated"):
        ScenePrior.load(directory)


def test_an_unknown_prior_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="dimsum_table"):
        ScenePrior.load("dimsum_tabel")


def test_a_directory_without_a_prior_says_so(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"config\.json"):
        ScenePrior.load(tmp_path)
