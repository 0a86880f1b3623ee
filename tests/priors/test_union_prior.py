"""Priors of several scene types: samples with the assets of one type at a time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from agents.diffusion import CategoricalProcess, StepTable
from agents.diffusion.categorical import make_categorical_schedule
from agents.priors.mixed import MixedPrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import UnknownNameError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, members_of

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
    prior.categories = CategoricalProcess(make_categorical_schedule("absorbing", prior.config.num_timesteps), kinds)
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
