"""Bits of the results of physics after other scenes, in other processes, and with other numbers of workers.

    python benchmarks/reproducibility.py [TYPE ...] [--noise 0.004 0.015 0.03] [--seed 5]

Scenes are the fullest of six draws of each grammar, a scene for each level of noise (m along every axis). `settle`,
`project`, `feasibility` and `make_ready` take them as one batch; then one by one, in a random order of scenes and
functions; then in two worker processes. The output is the number of comparisons, and how many differ in a bit.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, feasibility, make_ready, project, settle
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

NOISE = (0.004, 0.015, 0.03)


def crowded(name: str, noise: Sequence[float] = NOISE, seed: int = 5) -> SceneBatch:
    """The fullest of six draws, a scene for each level of ``noise`` (m)."""
    drawn = get_grammar(name).sample(np.random.default_rng(seed), 6)
    clean = drawn[drawn.counts.argsort(descending=True)[: len(noise)]]
    scale = torch.tensor(noise)[:, None, None]
    moved = scale * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(seed))
    return clean.with_poses(clean.translations + moved * clean.is_free.unsqueeze(-1), clean.rotations)


def settled(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    """The result of `settle` after 0.25 s."""
    result = settle(batch, duration=0.25, pool=pool)
    return [result.batch.tensor, result.valid]


def projected(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    """The result of `project`."""
    result = project(batch, pool=pool)
    return [result.batch.tensor, result.residual_depth, result.converged]


def judged(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    """The result of `feasibility`."""
    result = feasibility(batch, pool=pool)
    return [result.feasible, result.depth, result.displacement, result.rotation, result.valid]


def made_ready(batch: SceneBatch, pool: PhysicsPool | None = None) -> list[Tensor]:
    """The result of `make_ready` after one round of 0.25 s."""
    result = make_ready(batch, duration=0.25, rounds=1, pool=pool)
    return [result.batch.tensor, result.ready, result.valid]


FUNCTIONS: dict[str, Callable[..., list[Tensor]]] = {
    "settle": settled,
    "project": projected,
    "feasibility": judged,
    "make_ready": made_ready,
}


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    """Whether all tensors agree bit for bit."""
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def comparisons(batch: SceneBatch, pool: PhysicsPool, seed: int) -> dict[tuple[str, int], bool]:
    """Whether each comparison agrees, by function and scene; scene -1 is the batch in workers."""
    expected = {key: function(batch) for key, function in FUNCTIONS.items()}
    calls = [(key, row) for key in FUNCTIONS for row in range(len(batch))]
    agree = {}
    for index in np.random.default_rng(seed).permutation(len(calls)):
        key, row = calls[index]
        alone = FUNCTIONS[key](batch[row : row + 1])
        agree[key, row] = same(alone, [values[row : row + 1] for values in expected[key]])
    for key, function in FUNCTIONS.items():
        agree[key, -1] = same(function(batch, pool), expected[key])
    return agree


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"of {', '.join(list_scene_types())}")
    parser.add_argument("--noise", type=float, nargs="+", default=list(NOISE))
    parser.add_argument("--seed", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| scene type | objects | comparisons | differ | seconds |\n|---|---|---|---|---|", flush=True)
    with PhysicsPool(workers=2) as pool:
        for name in options.types or list_scene_types():
            started = time.monotonic()
            batch = crowded(name, options.noise, options.seed)
            agree = comparisons(batch, pool, options.seed)
            differ = [f"{key} of scene {row}" for (key, row), good in agree.items() if not good]
            row = (name.replace("_", " "), int(batch.counts.sum()), len(agree), len(differ))
            print("| " + " | ".join(map(str, row)) + f" | {time.monotonic() - started:.0f} |", *differ, flush=True)


if __name__ == "__main__":
    main()
