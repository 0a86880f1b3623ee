"""Plans of a few scenes on an untrained prior, for tests of planners."""

from __future__ import annotations

from typing import Any

from agents.planning import PlanResult
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.envs import SearchEnv
from scene_envs.scene import SceneBatch

SLOTS = 12


def near_middle(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Half of the free objects within 20 cm of the middle, so that Φ stays below 1; the others are to blame."""
    central = batch.is_free & (batch.translations[..., :2].norm(dim=-1) < 0.2)
    return RewardOutput(0.5 * central.sum(-1).float(), object_flags={"feasible": central})


def plan(planner: Any, process: str = "mixed", budget: int = 14) -> tuple[PlanResult, SearchEnv]:
    """A plan from nothing but the prior; the environment counts denoiser evaluations."""
    prior = tiny_prior(process=process)
    env = SearchEnv(prior=prior, objective=near_middle, branching=50, num_steps=4, max_depth=50, slots=SLOTS)
    env.reset(seed=1, options={"scene": SceneBatch.empty(prior.scene_type, 1, SLOTS)})
    return planner.plan(env, budget), env
