"""Cost of a search beside the denoiser, and results of inpaintings of many slots; commands of search.py."""

from __future__ import annotations

import argparse
import itertools
import time
import tracemalloc
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from agents.planning.gradient import Guidance, overlap
from agents.planning.ledger import planner_settings
from scene_envs.envs import SearchEnv
from scene_envs.envs.masks import BalancedMask, CulpritsMask, resolve_mask
from scene_envs.envs.scoring import RewardScorer, resolve_prior
from scene_envs.scene import SceneBatch

CONSOLE = Console(width=120)


def crowding(options: argparse.Namespace) -> None:
    """Objects before and after an inpainting of the culprits and of some empty slots."""
    prior, scorer = resolve_prior(options.prior), RewardScorer("feasible_objects")
    generators = [torch.Generator().manual_seed(options.seed + i) for i in range(options.samples)]
    empty = SceneBatch.empty(prior.scene_type, options.samples)
    everything = torch.ones(empty.tensor.shape[:2], dtype=torch.bool)
    batch = prior.inpaint(empty, everything, num_steps=options.num_steps, generators=generators)
    score = scorer(batch)
    table = Table("masked besides the culprits", "free objects after", "observed still feasible", "feasible after")
    culprits = CulpritsMask(at_least=0)
    rows = [
        culprits(batch[i], score.row(i), np.random.default_rng(options.seed + i)) if batch[i].is_free.any() else None
        for i in range(len(batch))
    ]
    fixed = torch.stack([torch.zeros(everything.shape[1], dtype=torch.bool) if row is None else row for row in rows])
    before = batch.is_free.sum(-1).float().mean(), score.value.mean(), fixed.sum(-1).float().mean()
    CONSOLE.print("free objects {:.1f}, feasible {:.1f}, culprits {:.1f}".format(*map(float, before)))
    gone = batch.is_free & ~fixed
    CONSOLE.print(f"without the culprits: {float(gone.sum(-1).float().mean()):.1f} objects")
    shuffled = torch.zeros_like(everything)
    for row, empties in zip(shuffled, batch.is_empty, strict=True):
        row[1 + torch.randperm(len(row) - 1, generator=generators[0])[: int(empties.sum())]] = True
    new = prior.inpaint(batch, shuffled, num_steps=options.num_steps, generators=generators)
    counts = [float((scenes.is_free & shuffled).sum(-1).float().mean()) for scenes in (batch, new)]
    CONSOLE.print("as many random slots as are empty: {:.1f} objects in them before, {:.1f} after".format(*counts))
    balanced = [
        BalancedMask()(batch[i], score.row(i), np.random.default_rng(options.seed + i)) for i in range(len(batch))
    ]
    counts = [f"A scene with {count} objects." for count in batch.counts.tolist()]
    tries: dict[str, tuple[torch.Tensor, dict[str, Any]]] = {}
    for slots in (0, 2, 4, 8):
        mask = fixed.clone()
        for row, empties in zip(mask, batch.is_empty, strict=True):
            row[empties.nonzero().flatten()[:slots]] = True
        tries[str(slots)] = mask, {}
    tries["balanced"] = torch.stack(balanced), {}
    tries["all"] = fixed | batch.is_empty, {}
    if prior.conditional:
        tries["all, the prompt being the number of objects"] = fixed | batch.is_empty, {"prompt": counts}
    for name in ("balanced", "all"):
        tries[f"{name}, guided apart"] = tries[name][0], {"guide": Guidance(overlap, 1.0, 0.5)}
    for name, (mask, how) in tries.items():
        new = prior.inpaint(batch, mask, num_steps=options.num_steps, generators=generators, **how)
        flags = scorer(new).object_flags["feasible"]
        kept = batch.is_free & score.object_flags["feasible"] & ~mask
        share = float((flags & kept).sum() / kept.sum())
        cells = (new.is_free.sum(-1).float().mean(), flags.sum(-1).float().mean())
        table.add_row(name, f"{cells[0]:.1f}", f"{share:.0%}", f"{cells[1]:.1f}")
    CONSOLE.print(table)


class Trivial:
    """An endless tree that costs no time. A state is a path, and its value grows with the length of the path."""

    def clone_state(self) -> tuple[int, ...]:
        """The root."""
        return ()

    def legal_actions(self, state: tuple[int, ...]) -> Sequence[int]:
        """Any number of children."""
        return range(1_000_000)

    def expand_batch(self, pairs: Sequence[tuple[tuple[int, ...], int]], steering: Any = None) -> list[tuple[int, ...]]:
        """The longer paths; no longer than 100."""
        return [(*state, action) if len(state) < 100 else (*state[:-1], action) for state, action in pairs]

    def evaluate(self, state: tuple[int, ...]) -> float:
        """A pseudo-random value, on average larger for longer paths."""
        return 0.5 * len(state) / 101 + (hash(state) % 997) / 2000


class Stopwatch:
    """Seconds inside calls of a function."""

    def __init__(self, inner: Any) -> None:
        self.inner, self.seconds = inner, 0.0

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call the function and add its seconds."""
        begun = time.perf_counter()
        try:
            return self.inner(*arguments, **keywords)
        finally:
            self.seconds += time.perf_counter() - begun


def overhead(options: argparse.Namespace) -> None:
    """Time per expansion as a search grows, memory per node, and the share of a real search."""
    table = Table("planner", *(f"ms, {1000 * n} on" for n in range(options.expansions // 1000)), "kB per node")
    for name in options.planners:
        planner = planner_settings(name)().make(options.branching)
        marks: list[tuple[int, float]] = [(0, time.process_time())]

        def note(done: int, best: float, marks: list[tuple[int, float]] = marks) -> None:
            if done // 1000 > marks[-1][0] // 1000:
                marks.append((done, time.process_time()))

        planner.plan(Trivial(), options.expansions, note)
        per = [1e3 * (b[1] - a[1]) / (b[0] - a[0]) for a, b in itertools.pairwise(marks)]
        tracemalloc.start()
        kept = planner.plan(Trivial(), options.expansions)
        size = tracemalloc.get_traced_memory()[0] / options.expansions / 1e3
        tracemalloc.stop()
        del kept
        table.add_row(name, *(f"{ms:.3f}" for ms in per), f"{size:.2f}")
    CONSOLE.print(table)
    prior = resolve_prior(options.prior)
    inpaint, mask = Stopwatch(prior.inpaint), Stopwatch(resolve_mask(options.mask))
    prior.inpaint = inpaint
    table = Table("planner", "s", "denoiser", "objective", "mask", "the rest")
    for name in options.planners:
        env = SearchEnv(prior=prior, objective=options.objective, mask=mask, branching=options.scenes, max_depth=1000)
        objective = Stopwatch(env.problem.scorer)
        env.problem.scorer = objective
        env.reset(seed=options.seed, options={"scene": SceneBatch.empty(prior.scene_type, 1)})
        planner = planner_settings(name)().make(options.branching)
        inpaint.seconds = objective.seconds = mask.seconds = 0.0
        begun = time.perf_counter()
        planner.plan(env, options.scenes)
        total = time.perf_counter() - begun
        parts = [inpaint.seconds, objective.seconds, mask.seconds]
        table.add_row(name, f"{total:.1f}", *(f"{part / total:.1%}" for part in [*parts, total - sum(parts)]))
    CONSOLE.print(table)
