"""Furniture of rooms under inpainting: what stands stays, and regenerated slots add none."""

from __future__ import annotations

import pytest
import torch

from agents.priors.base import ScenePrior
from agents.priors.mixed import MixedPrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import SearchEnv
from scene_envs.scene import SceneBatch


class RandomCategories(torch.nn.Module):
    """A mixed denoiser with a random favourite category for every slot, the same in every scene."""

    drops_empty = False
    text_encoder = None

    def forward(self, x: torch.Tensor, *_: object) -> tuple[torch.Tensor, torch.Tensor]:
        logits = torch.randn(x.shape[1], x.shape[2] - 12, generator=torch.Generator().manual_seed(0))
        return torch.zeros(*x.shape[:2], 12), logits.expand(len(x), -1, -1)


@pytest.fixture(params=["mixed", "continuous"], scope="module")
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    prior = tiny_prior("restaurant_low_clutter", process=request.param)
    if isinstance(prior, MixedPrior):
        prior.denoiser = RandomCategories()
    return prior


@pytest.fixture(scope="module")
def rooms(prior: ScenePrior) -> SceneBatch:
    """Samples that hold furniture."""
    return prior.sample(3, num_steps=4, seed=0)


def furniture(batch: SceneBatch) -> torch.Tensor:
    """(B, N) bool: generated welded objects."""
    welded = batch.is_welded
    welded[:, : len(batch.scene_type.fixed)] = False
    return welded


def test_regenerated_slots_add_no_furniture_to_furniture_that_is_kept(prior: ScenePrior, rooms: SceneBatch) -> None:
    assert bool(furniture(rooms).any(dim=1).all())
    changed = prior.inpaint(rooms, ~rooms.is_welded, num_steps=4, seed=1)
    assert torch.equal(furniture(changed), furniture(rooms))
    assert bool(changed.is_free.any(dim=1).all())
    filled = prior.complete(rooms, slots=rooms.tensor.shape[1] + 10, num_steps=4)
    assert torch.equal(furniture(filled).sum(dim=1), furniture(rooms).sum(dim=1))


def test_an_unfurnished_room_and_masked_furniture_get_furniture(prior: ScenePrior, rooms: SceneBatch) -> None:
    empty = SceneBatch.empty(prior.scene_type, 3)
    assert bool(furniture(prior.complete(empty, num_steps=4)).any(dim=1).all())
    mask = torch.zeros_like(rooms.is_empty)
    mask[:, 1:] = True
    first = furniture(rooms).int().argmax(dim=1)
    mask[0, first[0]] = False  # one piece stays and the others are made anew
    assert int(furniture(prior.inpaint(rooms, mask, num_steps=4, seed=2))[0].sum()) > 1


def test_a_room_of_a_batch_does_not_depend_on_the_others(prior: ScenePrior, rooms: SceneBatch) -> None:
    mixed = SceneBatch(torch.cat([rooms.tensor[:1], SceneBatch.empty(prior.scene_type, 1).tensor]), prior.scene_type)
    mask = ~mixed.is_welded
    generators = [torch.Generator().manual_seed(seed) for seed in (5, 6)]
    both = prior.inpaint(mixed, mask, num_steps=4, generators=generators)
    alone = prior.inpaint(mixed[0], mask[:1], num_steps=4, generators=[torch.Generator().manual_seed(5)])
    torch.testing.assert_close(both[0].tensor, alone.tensor, atol=1e-5, rtol=0)
    assert bool(furniture(both)[1].any())


def test_a_search_furnishes_a_room_once(prior: ScenePrior) -> None:
    env = SearchEnv(
        prior=prior, objective="feasible_objects", mask="infeasible_or_empty", num_steps=4, branching=1, max_depth=3
    )
    env.reset(seed=0, options={"scene": SceneBatch.empty(prior.scene_type, 1)})
    state = env.expand(env.clone_state(), 0)
    begun = furniture(env.scene(state))
    assert bool(begun.any())
    for _ in range(2):
        if not env.legal_actions(state):
            break
        state = env.expand(state, 0)
        assert torch.equal(furniture(env.scene(state)), begun)
    env.close()
