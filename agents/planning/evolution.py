"""Evolution: the planner that splices and inpaints pairs of scenes of a population."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.planning.ledger import (
    Candidate,
    Member,
    PlannerSettings,
    PlanResult,
    Progress,
    Searchable,
    SearchBudget,
    best_different,
    register_planner,
    state_value,
)
from scene_envs.errors import Count, Natural, Share

if TYPE_CHECKING:
    from torch import Tensor

    from scene_envs.scene import SceneBatch


@register_planner("evolution")
@dataclass(frozen=True)
class EvolutionPlanner(PlannerSettings):
    """Evolution with cut and splice as crossover (Deaven and Ho 1995).

    The population begins with fresh samples, or with the start scene of the search and inpaintings of it. A round makes
    ``children`` offspring. A parent is the better of two random members. With one parent, the offspring is an
    inpainting of the parent. With two parents, it is a splice of them (:func:`spliced`), which
    gets its own mask and is inpainted; the splice costs no denoiser evaluation. The best distinct scenes, old and new,
    are the next population. If two scenes have equal values, the newer one stays.

    Attributes:
        population: number of scenes that are kept, and of fresh samples at the start.
        children: number of offspring per round, one batch of the denoiser; null takes ``branching``.
        crossover: probability that an offspring has two parents.
        seed: seed of parents and cuts, together with the seed of the root.
    """

    name: str = "evolution"
    widens = True
    population: Count = 8
    children: Count | None = None
    crossover: Share = 0.5
    seed: Natural = 0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state; without ``with_scene`` there are no splices."""
        search = SearchBudget(problem, budget, progress)
        rng = search.generator(self.seed)
        fresh = search.actions(search.root)
        members: list[Member] = []  # the best first
        while search.left:
            pairs = []
            for _ in range(self.children or 1 if members else 0):
                index = _better_of_two(members, rng)
                parent, actions = members[index]
                if actions:
                    pairs.append((self._mated(search, index, members, rng), actions[0]))
                    members[index] = parent, actions[1:]
            if not pairs:  # at the beginning, and when no drawn parent has an action left
                pairs = [(search.root, action) for action in fresh[: self.population]]
                fresh = fresh[self.population :]
            if not pairs:
                break
            born = [(child, search.actions(child)) for child in reversed(search.expand(pairs)) if child.valid]
            if search.root.valid and not members:
                members, fresh = [(search.root, fresh)], []
            members = best_different([*born, *members], self.population)
        return search.result()

    def _mated(self, search: SearchBudget, index: int, members: list[Member], rng: np.random.Generator) -> Candidate:
        """The candidate to inpaint: a member, or its splice with another one."""
        problem: Any = search.problem
        (parent, _), others = members[index], members[:index] + members[index + 1 :]
        if not others or not hasattr(problem, "with_scene") or rng.random() >= self.crossover:
            return parent
        mate = others[_better_of_two(others, rng)][0].state
        scene = spliced(problem.scene(parent.state), problem.scene(mate), parent.state.mask, mate.mask, rng)
        state = problem.with_scene(parent.state, scene)
        child = replace(parent, state=state, value=state_value(problem, state))
        search.keep(child)
        return child if search.actions(child) else parent


def _better_of_two(members: Sequence[Member], rng: np.random.Generator) -> int:
    """Index of the better of two random members; ``members`` are sorted by value, the best first."""
    return int(rng.integers(len(members), size=2).min())


_MIN_SHARE = 0.25
"""A cut leaves about this share, or more, of the objects of both scenes together on either side."""


def spliced(
    first: SceneBatch, second: SceneBatch, first_mask: Tensor, second_mask: Tensor, rng: np.random.Generator
) -> Tensor:
    """(N, D) raw scene with the objects of ``first`` on one side of a vertical plane of random direction, and those of
    ``second`` on the other. The plane is placed where most objects are kept, with about a quarter of them or more on
    either side; with too few slots, those nearest to it are left out. The fixed objects are those of ``first``; slots
    of the masks (N,) are left out.
    """
    import torch

    fixed = torch.arange(first.tensor.shape[1]) < len(first.scene_type.fixed)
    angle = rng.uniform(0, 2 * np.pi)
    normal = torch.tensor([np.cos(angle), np.sin(angle)], dtype=torch.float32)
    rows, places = [], []
    for scene, mask in ((first, first_mask), (second, second_mask)):
        kept = ~(scene.is_empty[0] | mask | fixed)
        rows.append(scene.tensor[0, kept])
        places.append(scene.translations[0, kept, :2] @ normal)
    result = first.empty(first.scene_type, 1, len(fixed)).tensor[0]
    result[fixed] = first.tensor[0, fixed]
    cuts = torch.cat(places).sort().values
    if not len(cuts):
        return result
    edge = int(_MIN_SHARE * (len(cuts) - 1))
    cuts = cuts[edge : len(cuts) - edge]
    gained = (places[0] >= cuts[:, None]).sum(-1) + (places[1] < cuts[:, None]).sum(-1)
    cut = cuts[gained.argmax()]
    sides = places[0] >= cut, places[1] < cut
    objects = torch.cat([part[side] for part, side in zip(rows, sides, strict=True)])
    distances = torch.cat([(place[side] - cut).abs() for place, side in zip(places, sides, strict=True)])
    objects = objects[distances.argsort(descending=True, stable=True)][: int((~fixed).sum())]
    result[len(first.scene_type.fixed) :][: len(objects)] = objects
    return result
