"""Priors of rooms: assets of fixed objects, furniture under inpainting, and priors of several scene types."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import pytest
import torch

from agents.diffusion import CategoricalProcess, Preconditioning, StepTable
from agents.diffusion.categorical import make_categorical_schedule
from agents.diffusion.reverse_steps import one_hot_state
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import SearchEnv
from scene_envs.errors import UnknownNameError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, members_of

TABLE, KINDS = 0, 8
KERNELS = ("squared_absorbing", "mask_and_replace")


class WantsTables(torch.nn.Module):
    """A denoiser that sees a table in nine of ten slots."""

    drops_empty = False
    text_encoder = None

    def forward(self, x: torch.Tensor, *_: object) -> tuple[torch.Tensor, torch.Tensor]:
        probs = torch.full((*x.shape[:2], KINDS), 0.1 / (KINDS - 1))
        probs[..., TABLE] = 0.9
        return torch.zeros(*x.shape[:2], 12), probs.log()


@pytest.fixture(params=KERNELS)
def mixed(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> MixedPrior:
    prior = tiny_prior(process="mixed")
    assert isinstance(prior, MixedPrior)
    schedule = make_categorical_schedule(request.param, prior.config.num_timesteps)
    monkeypatch.setattr(prior, "categories", CategoricalProcess(schedule, KINDS))
    prior._together = prior._together and prior.categories.only_absorbs
    prior.denoiser = WantsTables()
    return prior


def free_tables(batch: SceneBatch) -> int:
    return int((batch.categories[:, 1:] == TABLE).sum())


def test_no_second_table_is_sampled_or_inpainted(mixed: MixedPrior) -> None:
    batch = mixed.sample(20, num_steps=7, seed=0)
    assert free_tables(batch) == 0
    assert batch.categories[:, 0].tolist() == [TABLE] * 20
    assert int(batch.is_free.sum()) > 300
    assert free_tables(mixed.inpaint(batch, batch.is_free, num_steps=5, seed=1)) == 0


def test_the_last_step_leaves_no_table_and_probabilities_add_up_to_one(mixed: MixedPrior) -> None:
    table = mixed.step_table(4)
    x = mixed.initial(3, 34, torch.Generator().manual_seed(0))
    for step in range(4):
        probs = mixed.transition(x, step, table).probs
        torch.testing.assert_close(probs.sum(dim=-1), torch.ones(3, 34))
    assert float(probs[:, 1:, TABLE].max()) == 0.0
    torch.testing.assert_close(probs[:, 1:, 1:KINDS].sum(dim=-1), torch.ones(3, 33))


@torch.no_grad()
def test_log_probabilities_are_those_of_the_states_that_can_be_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over all states of one slot they sum to one, and the table has no share of it."""
    prior = tiny_prior(process="mixed")
    assert isinstance(prior, MixedPrior)
    monkeypatch.setattr(
        prior, "categories", CategoricalProcess(make_categorical_schedule("early_absorbing", 1000), KINDS)
    )
    table = prior.step_table(2)
    x = prior.initial(1, 34, torch.Generator().manual_seed(0))
    step = prior.transition(x, 0, table)
    states = torch.arange(KINDS + 1).unsqueeze(-1).expand(-1, 34)  # (9, 34)
    drawn = torch.cat([step.mean.expand(KINDS + 1, -1, -1), one_hot_state(states, step.probs)], dim=-1)
    many = step._replace(mean=step.mean.expand(KINDS + 1, -1, -1), probs=step.probs.expand(KINDS + 1, -1, -1))
    discrete = many.log_prob(drawn) - many._replace(probs=torch.ones_like(many.probs)).log_prob(drawn)
    probability = discrete[:, 1:].double().exp()
    torch.testing.assert_close(probability.sum(dim=0), torch.ones(33, dtype=torch.float64), atol=1e-5, rtol=0)
    assert float(probability[TABLE].max()) < 1e-20


def test_gradients_stay_finite() -> None:
    prior = tiny_prior(process="mixed")
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    step = prior.transition(x, 0, prior.step_table(3))
    step.log_prob(step.from_noise(torch.randn(x.shape)).detach()).sum().backward()
    gradients = [p.grad for p in prior.parameters() if p.grad is not None]
    assert gradients
    assert all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


def test_an_observed_second_table_is_kept(mixed: MixedPrior) -> None:
    batch = mixed.sample(2, num_steps=3, seed=0)
    categories = batch.categories.clone()
    categories[:, 5] = TABLE
    given = SceneBatch.from_parts(batch.translations, torch.eye(3).expand(2, 34, 3, 3), categories, batch.scene_type)
    mask = torch.ones(2, 34, dtype=torch.bool)
    mask[:, 5] = False
    changed = mixed.inpaint(given, mask, num_steps=4, seed=2)
    assert torch.equal(changed.tensor[:, 5], given.tensor[:, 5])
    assert free_tables(changed) == 2


@pytest.mark.parametrize("rotation", ["matrix", "quaternion"])
def test_a_continuous_prior_takes_the_next_best_category(rotation: str) -> None:
    prior = tiny_prior()
    features = 20 if rotation == "matrix" else 15
    network = dataclasses.replace(prior.config.network, features=features)
    prior = type(prior)(
        dataclasses.replace(prior.config, rotation=rotation, network=network),
        prior.normalizer,
        Preconditioning(torch.zeros(features), torch.ones(features)),
    )
    assert isinstance(prior, ScenePrior)
    x = torch.zeros(1, 34, prior.features)
    x[..., -KINDS + TABLE], x[..., -KINDS + 3], x[..., -1] = 0.9, 0.2, -0.5
    x[:, 20:, -1] = 1.0
    before = x.clone()
    decoded = prior.decode(x)
    assert decoded.categories[0].tolist() == [TABLE] + [3] * 19 + [7] * 14
    assert torch.equal(x, before)


@torch.no_grad()
def test_rooms_place_their_tables_where_they_like() -> None:
    """Only what is fixed is barred: a restaurant's tables are welded, and stand in free slots."""
    prior = tiny_prior("restaurant_low_clutter", process="mixed")
    assert isinstance(prior, MixedPrior)
    floor, table = (prior.scene_type.assets.index(name) for name in ("floor", "cafe_table"))
    step = prior.transition(prior.initial(1, 20), 0, prior.step_table(1))
    assert float(step.probs[0, 1:, floor].max()) == 0.0
    assert float(step.probs[0, 1:, table].min()) > 0.0


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


UNION = "dimsum_table+pantry_shelf"


class EveryAssetAlike(torch.nn.Module):
    """A denoiser for which all categories are equally likely in every slot."""

    drops_empty = False
    text_encoder = None

    def __init__(self, kinds: int) -> None:
        super().__init__()
        self.kinds = kinds

    def forward(self, x: torch.Tensor, *_: object) -> tuple[torch.Tensor, torch.Tensor]:
        return torch.zeros(*x.shape[:2], 12), torch.zeros(*x.shape[:2], self.kinds)


@pytest.fixture
def union_prior() -> MixedPrior:
    prior = tiny_prior(UNION, process="mixed", slots=20)
    assert isinstance(prior, MixedPrior)
    kinds = prior.num_categories
    prior.categories = CategoricalProcess(
        make_categorical_schedule("early_absorbing", prior.config.num_timesteps), kinds
    )
    prior._together = True
    prior.denoiser = EveryAssetAlike(kinds)
    return prior


def mixes(batch: SceneBatch) -> list[bool]:
    """Whether each scene holds assets that no member has together."""
    members = [set(member.assets) for member in members_of(batch.scene_type)]
    held = [{name for name in names if name in batch.scene_type.assets} for names in batch.names()]
    return [not any(objects <= assets for assets in members) for objects in held]


def test_scenes_hold_the_assets_of_one_member(union_prior: MixedPrior) -> None:
    batch = union_prior.sample(40, num_steps=60, seed=0)
    assert int(batch.counts.min()) > 5
    assert not any(mixes(batch))
    both = {frozenset(name for name in names if name in batch.scene_type.assets) for names in batch.names()}
    dimsum, pantry = (set(get_scene_type(name).assets) for name in UNION.split("+"))
    assert any(objects <= dimsum for objects in both)
    assert any(objects <= pantry for objects in both)


def test_any_assets_can_be_asked_for(union_prior: MixedPrior) -> None:
    assert all(mixes(union_prior.with_union("any").sample(10, num_steps=20, seed=0)))


def test_settings_of_categories_are_those_of_mixed_priors_alone() -> None:
    mixed, continuous = tiny_prior(process="mixed"), tiny_prior(process="continuous")
    before = continuous.config
    assert mixed.with_union("any").with_open_empty(0.3) is mixed
    assert (mixed.config.union, mixed.config.open_empty_share) == ("any", 0.3)
    assert continuous.with_union("any").with_open_empty(0.3) is continuous
    assert continuous.config is before
    with pytest.raises(UnknownNameError, match="one_type"):
        continuous.with_union("one")


def test_an_unknown_rule_names_the_known_ones(union_prior: MixedPrior) -> None:
    with pytest.raises(UnknownNameError, match="one_type"):
        union_prior.with_union("one")
    with pytest.raises(UnknownNameError, match="one_type"):
        MixedPrior(replace(union_prior.config, union="one"), union_prior.normalizer, union_prior.preconditioning)


def test_probabilities_leave_out_what_does_not_fit_and_add_up_to_one(union_prior: MixedPrior) -> None:
    table = union_prior.step_table(20)
    x = union_prior.initial(2, 20, torch.Generator().manual_seed(0))
    assets = list(union_prior.scene_type.assets)
    x[0, 3, 12 + assets.index("steamer_bottom")] = 1.0  # found on the Dimsum table only
    step = union_prior.transition(x, 4, table)
    torch.testing.assert_close(step.probs.sum(dim=-1), torch.ones(2, 20))
    foreign = [index for index, name in enumerate(assets) if name not in get_scene_type("dimsum_table").assets]
    others = [slot for slot in range(20) if slot != 3]
    assert float(step.probs[0, others][:, foreign].max()) == 0.0
    assert float(step.probs[1][:, foreign].min()) > 0.0


def test_the_first_steps_decide_one_slot_each() -> None:
    schedule = make_categorical_schedule("early_absorbing", 1000)
    table = StepTable.gradual(schedule.mask, 125, 50)
    assert len(table) == 50
    decided = 125 * (schedule.mask[table.timesteps] - schedule.mask[table.previous])
    assert float(decided[:25].max()) < 1.5  # one, but for the rounding of timesteps
    assert float(decided.sum()) == pytest.approx(125.0)


@pytest.mark.parametrize("num_steps", [1, 2, 5, 333, 999, 1000])
def test_a_gradual_table_has_any_number_of_steps(num_steps: int) -> None:
    table = StepTable.gradual(torch.linspace(0, 1, 1001), 125, num_steps)
    assert len(table) == num_steps
    assert int(table.timesteps[0]) == 1000
    assert int(table.previous[-1]) == 0
