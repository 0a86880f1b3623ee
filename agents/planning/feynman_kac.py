"""Feynman-Kac steering: the planner that resamples scenes during their denoising by their expected objective."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from agents.planning.ledger import (
    PlannerSettings,
    PlanResult,
    Progress,
    Searchable,
    SteeredProblem,
    register_planner,
)
from agents.planning.simple import GreedyPlanner
from scene_envs.errors import BELOW_ONE, Count, at_least

if TYPE_CHECKING:
    from torch import Tensor

    from scene_envs.scene import SceneBatch


def systematic(weights: np.ndarray, uniform: float) -> np.ndarray:
    """(K,) index of the particle that each place continues with: systematic resampling (Carpenter et al. 1999). A
    particle with share w_i of the sum of the weights (K,) gets K w_i places on average over ``uniform`` in [0, 1), and
    always K w_i rounded down or up. A particle that gets any place keeps its own.

    >>> systematic(np.array([0.5, 0.0, 0.5, 0.0]), 0.5).tolist()
    [0, 0, 2, 2]
    """
    count = len(weights)
    edges = np.cumsum(weights)
    drawn = np.searchsorted(edges / edges[-1], (np.arange(count) + uniform) / count, side="right").clip(max=count - 1)
    rows = np.full(count, -1)
    survivors, repeats = np.unique(drawn, return_counts=True)
    rows[survivors] = survivors
    rows[rows < 0] = np.repeat(survivors, repeats - 1)
    return rows


class Particles:
    """Resampler of groups of particles, the children of one parent (``parents`` (B,) are hashable and have a generator
    each in ``rngs``) that are denoised in one batch. At ``resamplings`` steps the weights are exp(strength * (value -
    value at the last resampling)), whose product along a path is exp(strength * last value) (Singhal et al. 2025,
    difference potential). ``values`` gives Φ (B,) of denoised scenes.
    """

    def __init__(
        self,
        parents: Sequence[Any],
        rngs: dict[Any, np.random.Generator],
        values: Callable[[SceneBatch], Tensor],
        resamplings: int,
        begin: float,
        strength: float,
    ) -> None:
        self.groups = {parent: np.flatnonzero([parent == other for other in parents]) for parent in rngs}
        self.rngs, self.values = rngs, values
        self.resamplings, self.begin, self.strength = resamplings, begin, strength
        self.before = np.zeros(len(parents))

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch]) -> Tensor | None:
        """(B,) index of the particle that each place continues with; None at a step without resampling."""
        import torch

        if step not in self.at(steps):
            return None
        now = self.values(denoised()).double().numpy()
        rows = np.arange(len(now))
        for parent, group in self.groups.items():
            log_weights = self.strength * (now[group] - self.before[group])
            rows[group] = group[systematic(np.exp(log_weights - log_weights.max()), self.rngs[parent].random())]
        self.before = now[rows]
        return torch.from_numpy(rows)

    def at(self, steps: int) -> list[int]:
        """Steps at which particles are resampled: evenly spaced from ``begin`` on, without the last."""
        first = int(self.begin * steps)
        return sorted({first + (i * (steps - 1 - first)) // self.resamplings for i in range(self.resamplings)})


@register_planner("feynman_kac")
@dataclass(frozen=True)
class FeynmanKacPlanner(PlannerSettings):
    """Feynman-Kac steering of every inpainting (Singhal et al. 2025), in rounds of iterated repair.

    A round denoises ``particles`` inpaintings of the current state in one batch. During the denoising, the objective
    scores the scene that the network expects of each particle, and particles with higher scores replace others. The
    finished scenes are treated as in :class:`~agents.planning.GreedyPlanner`. Resampling costs evaluations of the
    objective, but none of the denoiser.

    Attributes:
        particles: number of inpaintings per round, one batch of the denoiser.
        resamplings: number of resamplings per round.
        begin: share of the denoising steps before the first resampling.
        strength: λ in the weight exp(λ Φ) of a particle; 0 resamples nothing.
    """

    name: str = "feynman_kac"
    widens = True
    steers = True
    particles: Count = 8
    resamplings: Count = 2
    begin: Annotated[float, BELOW_ONE] = 0.7
    strength: Annotated[float, at_least(0)] = 50.0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(problem, self.name, self._steer)
        return GreedyPlanner(children=self.particles).plan(steered, budget, progress)

    def _steer(self, pairs: Sequence[tuple[Any, int]], values: Callable[[SceneBatch], Tensor]) -> Particles:
        parents, rngs = [(state.seed, state.path) for state, _ in pairs], {}
        for (seed, path), (_, action) in zip(parents, pairs, strict=True):
            if (seed, path) not in rngs:  # spawn keys 0 and 1 are for the noise and the mask of the child
                source = np.random.SeedSequence(entropy=seed, spawn_key=(*path, action, 2))
                rngs[seed, path] = np.random.default_rng(source)
        return Particles(parents, rngs, values, self.resamplings, self.begin, self.strength)
