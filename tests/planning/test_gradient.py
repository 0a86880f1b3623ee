"""Gradient guidance: tilts against closed forms, and the planners that it guides."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from agents.diffusion import GaussianProcess, Preconditioning, ResidualVariance, StepTable
from agents.diffusion.gaussian import make_schedule
from agents.planning import EvolutionPlanner, GradientPlanner
from agents.planning.gradient import Guidance, overlap
from agents.planning.ledger import planner_settings
from agents.priors.testing import tiny_prior
from scene_envs.envs import SearchEnv
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.scene import CATEGORY, TRANSLATION, SceneBatch
from tests.helpers.small_plans import SLOTS, near_middle, plan
from tests.helpers.toy_prior import ToyPrior
from tests.helpers.toy_tree import ToyTree, scrambled

PROCESSES = pytest.mark.parametrize("process", ["mixed", "continuous"])


def exact_chain(strength: float, residual: bool) -> Tensor:
    """(20000, 1) samples of N(0.2, 0.5²) tilted by exp(strength x), by 50 steps of its exact denoiser."""
    mean, std, count = 0.2, 0.5, 20_000
    schedule = make_schedule("linear", 1000)
    process = GaussianProcess(schedule, "edm", Preconditioning(torch.tensor([mean]), torch.tensor([std])))
    table = StepTable.spaced(1000, 50)
    alpha, sigma = process.alpha, process.sigma
    errors = (sigma * std) ** 2 / ((alpha * std) ** 2 + sigma**2)  # of the denoised value
    grid = torch.arange(1, 1001)
    known = ResidualVariance(grid, errors[1:, None]) if residual else None
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 1, 1, generator=generator)
    for step in range(len(table)):
        t, s = int(table.timesteps[step]), int(table.previous[step])
        gain = alpha[t] * std**2 / ((alpha[t] * std) ** 2 + sigma[t] ** 2)
        x0 = mean + gain * (x - alpha[t] * mean)
        moved, noise = process.posterior(x, x0, t, s, ResidualVariance(grid, errors[1:, None]).at(t))
        weight, deviation = process.estimate(t, s, known)
        x = moved + weight * deviation**2 * strength + noise * torch.randn(x.shape, generator=generator)
    return x.flatten()


@pytest.mark.parametrize("residual", [True, False])
def test_a_tilted_normal_distribution_is_sampled_exactly(residual: bool) -> None:
    x = exact_chain(strength=1.5, residual=residual)
    assert float(x.mean()) == pytest.approx(0.2 + 1.5 * 0.5**2, abs=0.015)  # N(m + λ v, v)
    assert float(x.std()) == pytest.approx(0.5, abs=0.02)


@PROCESSES
def test_guidance_moves_what_is_regenerated_and_nothing_else(process: str) -> None:
    prior = tiny_prior(process=process)
    batch = prior.sample(3, num_steps=3, slots=SLOTS)
    mask = torch.zeros(3, SLOTS, dtype=torch.bool)
    mask[:, 4:] = True

    def up(batch: SceneBatch, translations: Tensor) -> Tensor:
        return translations[..., 0].sum(-1)

    plain = prior.inpaint(batch, mask, num_steps=4)
    none = prior.inpaint(batch, mask, num_steps=4, guide=Guidance(up, 0.0, 0.0))
    torch.testing.assert_close(none.tensor, plain.tensor, atol=0, rtol=0)
    moved = prior.inpaint(batch, mask, num_steps=4, guide=Guidance(up, 100.0, 0.5))
    assert torch.equal(moved.tensor[:, :4], batch.tensor[:, :4])
    there = ~moved.is_empty & ~plain.is_empty & mask
    assert bool((moved.translations[..., 0] > plain.translations[..., 0])[there].all())
    far = prior.inpaint(batch, mask, num_steps=4, guide=Guidance(up, 1e12, 0.5))  # limited by the deviation
    assert bool(torch.isfinite(far.tensor).all())


@pytest.mark.parametrize("name", ["greedy", "evolution", "beam"])
def test_without_strength_gradient_is_the_planner_that_it_guides(name: str) -> None:
    guided, env = plan(GradientPlanner(children=3, planner=name, strength=0.0), "mixed")
    plain, _ = plan(planner_settings(name)().make(3), "mixed")
    assert guided.values == plain.values
    assert env.nfe == 14 * 4


def test_gradient_hands_keys_on_to_the_planner_that_it_guides() -> None:
    guided, _ = plan(GradientPlanner(children=3, planner={"name": "evolution", "seed": 1}, strength=0.0), "continuous")
    plain, _ = plan(EvolutionPlanner(children=3, seed=1), "continuous")
    assert guided.values == plain.values


@pytest.mark.parametrize(
    ("planner", "message"),
    [
        (5, "planner=5 must be a planner's name, or a mapping of its name and keys"),
        ({"population": 3}, "must be a planner's name"),
        ("evolutoin", "unknown planner 'evolutoin'; did you mean 'evolution'"),
        ({"name": "evolution", "size": 3}, "size"),
        ({"name": "evolution", "population": "many"}, "planner.planner.population"),
    ],
)
def test_what_cannot_be_guided_is_told(planner: Any, message: str) -> None:
    with pytest.raises(SceneEnvsError, match=message):
        GradientPlanner(planner=planner)


def test_a_planner_that_steers_is_not_guided() -> None:
    with pytest.raises(InvalidInputError, match=r"'gradient' cannot be guided; give one of .*evolution, greedy"):
        GradientPlanner(planner="gradient")


def test_a_prior_that_cannot_be_guided_is_told() -> None:
    env = SearchEnv(prior=ToyPrior(), objective=near_middle, branching=10, num_steps=2, slots=SLOTS)
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match="inpaint of ToyPrior takes no guide=; choose a planner that does not"):
        GradientPlanner(children=2).plan(env, 4)


def test_overlap_is_half_the_square_of_the_smaller_depth() -> None:
    batch = SceneBatch.empty("dimsum_table", 1, 4)
    cup = next(i for i, asset in enumerate(batch.scene_type.library) if i not in batch.scene_type.welded_categories)
    rows = batch.tensor[0, 1:3]
    rows[:, CATEGORY] = 0
    rows[:, CATEGORY.start + cup] = 1
    corners = torch.from_numpy(
        __import__("scene_envs.assets.shapes", fromlist=["x"]).hull_of(batch.scene_type.library[cup].fine).vertices
    )
    radius, height = float(corners[:, :2].norm(dim=-1).amax()), float(corners[:, 2].amax() - corners[:, 2].amin())
    depth = 0.1 * min(radius, height)
    rows[:, TRANSLATION] = torch.tensor([[0.0, 0.0, 5.0], [2 * radius - depth, 0.0, 5.0]])  # far above the table
    translations = batch.translations.clone().requires_grad_()
    value = overlap(batch, translations)
    assert float(value.detach()) == pytest.approx(-0.5 * (1e3 * depth) ** 2, rel=1e-3)
    (gradient,) = torch.autograd.grad(value.sum(), translations)
    assert gradient[0, 1:3, 0].tolist() == pytest.approx([-1e6 * depth, 1e6 * depth], rel=1e-3)  # apart
    assert float(gradient[0, [0, 3]].abs().max()) == 0
    rows[1, 0] = 2 * radius + 1e-3
    assert float(overlap(batch, batch.translations)) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GradientPlanner(weight="overlaps"), "overlap"),
        (lambda: GradientPlanner(begin=1.0), "begin=1.0"),
        (lambda: GradientPlanner(strength=float("nan")), "strength"),
        (lambda: GradientPlanner().plan(ToyTree(scrambled), budget=5), "takes no steering="),
    ],
)
def test_bad_arguments_name_themselves(make: Any, message: str) -> None:
    with pytest.raises(SceneEnvsError, match=message):
        make()
