"""Planners of the search at equal NFE, inpainting of many slots at once, and what the search itself costs.

    python benchmarks/search.py compare [--planners NAME[:key=value,...] ...] [--seeds 0 1 2] [--scenes 300]
                                        [--at 64 300] [--prior dimsum_table] [--objective feasible_objects]
                                        [--branching 3] [--num-steps 50] [--mask culprits] [--records FILE]
    python benchmarks/search.py crowding [--prior dimsum_table] [--samples 24] [--seed 0]
    python benchmarks/search.py overhead [--planners NAME ...] [--expansions 5000] [--scenes 64]

`compare` runs every planner with every seed and prints the best objective after as many scenes as `--at` says, median
and range over the seeds. `--records` keeps the curve of each run as one line of JSON; runs that are in the file already
are not repeated. The first scenes of all planners are the same for one seed.

`crowding` masks random slots of samples, or their culprits and some of their empty slots, inpaints once, and counts
objects.

`overhead` times 5,000 expansions on a problem that costs nothing, 1,000 at a time, and the share of a real search that
is neither the denoiser, the objective nor the mask.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import statistics
import sys
import time
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from agents.planning import Session, list_planners
from agents.planning.registry import planner_settings
from scene_envs.envs import SearchEnv
from scene_envs.envs.mask_generators import CulpritsMask
from scene_envs.envs.masks import resolve_mask
from scene_envs.envs.resolvers import resolve_prior
from scene_envs.envs.scoring import RewardScorer
from scene_envs.scene import SceneBatch

CONSOLE = Console(width=120)


def planner_of(text: str) -> dict[str, Any]:
    """``NAME:key=value,...`` as a mapping of settings."""
    name, _, keys = text.partition(":")
    return {
        "name": name,
        **{key: json.loads(value) for key, value in (word.split("=") for word in keys.split(",") if word)},
    }


def word(text: str) -> Any:
    """A name, or the mapping of JSON that ``text`` is."""
    return json.loads(text) if text.startswith("{") else text


def slug(key: dict[str, Any]) -> str:
    """A file name for a run."""
    words = (key["prior"], key["objective"], key["mask"], key["planner"], key["slots"], key["num_steps"], key["seed"])
    return re.sub(r"[^A-Za-z0-9_.=]+", "-", "-".join(map(str, words)))


def run_together(prior: Any, keys: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records of runs that differ in their seed alone: in common batches of the denoiser, with the best scenes."""
    key = keys[0]
    planner = planner_of(key["planner"])
    settings = planner_settings(planner["name"])(**planner)
    env = SearchEnv(
        scene=prior.scene_type,
        prior=prior,
        objective=word(key["objective"]),
        mask=word(key["mask"]),
        slots=key["slots"],
        objective_scale=key["scale"],
        num_steps=key["num_steps"],
        branching=max(key["scenes"], key["branching"]) if settings.widens else key["branching"],
        max_depth=1000,
    )
    empty, roots = SceneBatch.empty(prior.scene_type, 1, env.problem.slots), []
    for each in keys:
        env.reset(seed=each["seed"], options={"scene": empty})
        roots.append(env.clone_state())
    session = Session(env)
    begun = time.process_time()

    def told(done: int, best: float) -> None:
        if done % 50 < len(keys) * key["branching"]:
            print(f"  {done} scenes, the worst search has {best:.3f}", flush=True)

    plans = session.run(settings.make(key["branching"]), roots, key["scenes"], told)
    if session.stopped:
        sys.exit(session.stopped)
    seconds = (time.process_time() - begun) / sum(len(plan.values) for plan in plans)
    env.close()
    return [
        {
            **each,
            "curve": [env.problem.scale * value for value in plan.curve],
            "objective_found": plan.best_state.objective,
            "seconds_per_scene": seconds,
            "together": len(keys),
            "best": env.scene(plan.best_state),
        }
        for each, plan in zip(keys, plans, strict=True)
    ]


def compare(options: argparse.Namespace) -> None:
    """Run what is not recorded, and print the table."""
    prior, records = resolve_prior(options.prior), Path(options.records)
    known = [json.loads(line) for line in records.read_text().splitlines()] if records.exists() else []
    names = ("prior", "objective", "branching", "num_steps", "mask", "scenes", "slots", "scale")
    common = {name: getattr(options, name) for name in names}

    def same(record: dict[str, Any], key: dict[str, Any]) -> bool:
        return all(record.get(name) == value for name, value in key.items())

    for planner in options.planners:
        keys = [{**common, "planner": planner, "seed": seed} for seed in options.seeds]
        keys = [key for key in keys if not any(same(record, key) for record in known)]
        for start in range(0, len(keys), options.together):
            for record in run_together(prior, keys[start : start + options.together]):
                best = record.pop("best")
                records.parent.mkdir(parents=True, exist_ok=True)
                best.save(records.parent / f"{slug(record)}.safetensors")
                known.append(record)
                with records.open("a") as file:
                    file.write(json.dumps(record) + "\n")
                curve = record["curve"]
                per = record["seconds_per_scene"]
                print(planner, record["seed"], f"{curve[-1]:g} after {len(curve)} scenes, {per:.3f} s each", flush=True)
    table = Table("planner", "seeds", *(f"after {at}" for at in options.at), "all of it after", "CPU s per scene")
    for planner in options.planners:
        runs = [r for r in known if same(r, {**common, "planner": planner}) and r["seed"] in options.seeds]
        if not runs:
            continue
        cells = []
        for at in options.at:
            values = [run["curve"][min(at, len(run["curve"])) - 1] for run in runs]
            cells.append(f"{statistics.median(values):g} ({min(values):g} to {max(values):g})")
        ended = sorted(len(run["curve"]) for run in runs if len(run["curve"]) < run["scenes"])
        cells.append(f"{', '.join(map(str, ended))}" if ended else "")
        seconds = statistics.median(run["seconds_per_scene"] for run in runs)
        table.add_row(planner, str(len(runs)), *cells, f"{seconds:.3f}")
    CONSOLE.print(table)


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
    for slots in (0, 2, 4, 8, 99):
        mask = fixed.clone()
        for row, empties in zip(mask, batch.is_empty, strict=True):
            row[empties.nonzero().flatten()[:slots]] = True
        new = prior.inpaint(batch, mask, num_steps=options.num_steps, generators=generators)
        flags = scorer(new).object_flags["feasible"]
        kept = batch.is_free & score.object_flags["feasible"] & ~mask
        share = float((flags & kept).sum() / kept.sum())
        cells = (new.is_free.sum(-1).float().mean(), flags.sum(-1).float().mean())
        table.add_row("all" if slots == 99 else str(slots), f"{cells[0]:.1f}", f"{share:.0%}", f"{cells[1]:.1f}")
    CONSOLE.print(table)


class Trivial:
    """A tree without an end whose states cost nothing: a path, and a value that grows with it."""

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
        """Scrambled, and larger for longer paths."""
        return 0.5 * len(state) / 101 + (hash(state) % 997) / 2000


class Stopwatch:
    """Seconds inside calls of a function."""

    def __init__(self, inner: Any) -> None:
        self.inner, self.seconds = inner, 0.0

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """Call it."""
        begun = time.perf_counter()
        try:
            return self.inner(*arguments, **keywords)
        finally:
            self.seconds += time.perf_counter() - begun


def overhead(options: argparse.Namespace) -> None:
    """Time per expansion as a search grows, memory per node, and the share of a real search."""
    table = Table("planner", *(f"ms, {1000 * n} on" for n in range(options.expansions // 1000)), "kB per node")
    for name in options.planners:
        planner = planner_settings(planner_of(name)["name"])(**planner_of(name)).make(options.branching)
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
        planner = planner_settings(planner_of(name)["name"])(**planner_of(name)).make(options.branching)
        inpaint.seconds = objective.seconds = mask.seconds = 0.0
        begun = time.perf_counter()
        planner.plan(env, options.scenes)
        total = time.perf_counter() - begun
        parts = [inpaint.seconds, objective.seconds, mask.seconds]
        table.add_row(name, f"{total:.1f}", *(f"{part / total:.1%}" for part in [*parts, total - sum(parts)]))
    CONSOLE.print(table)


def main() -> None:
    """Read the words and run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("compare", "crowding", "overhead"))
    parser.add_argument("--planners", nargs="+", default=list_planners())
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--at", nargs="+", type=int, default=[64, 300])
    parser.add_argument("--prior", default="dimsum_table")
    parser.add_argument("--objective", default="feasible_objects")
    parser.add_argument("--branching", type=int, default=3)
    parser.add_argument("--num-steps", type=int, default=50)
    parser.add_argument("--mask", default="culprits")
    parser.add_argument("--records", default="runs/search/records.jsonl")
    parser.add_argument("--together", type=int, default=5)
    parser.add_argument("--slots", type=int)
    parser.add_argument("--scale", type=float)
    parser.add_argument("--samples", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--expansions", type=int, default=5000)
    options = parser.parse_args()
    {"compare": compare, "crowding": crowding, "overhead": overhead}[options.what](options)


if __name__ == "__main__":
    main()
