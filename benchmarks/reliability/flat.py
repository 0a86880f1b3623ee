"""Trials of long use: memory and descriptors after thousands of episodes and calls of physics."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.reliability.figures import Figures
from benchmarks.reliability.small_commands import place

if TYPE_CHECKING:
    import gymnasium

_POINTS = 10
_RISE = 8.0
"""MiB by which memory may rise over the second half; an allocator alone varies by as much."""


def episodes(count: int, seed: int = 0) -> Figures:
    """Episodes of the environments, one after the other: four in ten denoise, one searches, five are in a vector."""
    import gymnasium
    import torch

    torch.set_num_threads(1)
    single = gymnasium.make("scene_envs:SceneEnvs/Denoising-v0", reward="object_count", num_steps=3)
    vector = gymnasium.make_vec("scene_envs:SceneEnvs/Denoising-v0", num_envs=5, reward="object_count", num_steps=3)
    search = gymnasium.make(
        "scene_envs:SceneEnvs/Search-v0", prior=f"{place()}/mixed", objective="object_count", objective_scale=30.0,
        num_steps=1, branching=2, max_depth=2, slots=6,
    )  # fmt: skip

    def one(number: int) -> None:
        kind = number % 10
        if kind < 4:
            _play(single, number)
        elif kind == 4:
            _play(search, number)
        elif kind == 5:  # five side by side stand for the numbers 5 to 9
            vector.reset(seed=number)
            for _ in range(3):
                vector.step(vector.action_space.sample())

    return _flat(one, count, "episodes")


def physics_calls(count: int, seed: int = 0) -> Figures:
    """Calls of feasibility, penetration and readiness on scenes of the grammar, with and without objects moved."""
    import torch

    from scene_envs import SceneBatch, physics
    from scene_envs.grammars import get_grammar

    torch.set_num_threads(1)
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(seed), 16)

    def one(number: int) -> None:
        batch = scenes[number % 16 : number % 16 + 1]
        if number % 2:
            moved = batch.tensor.clone()
            noise = torch.randn(moved[..., :3].shape, generator=torch.Generator().manual_seed(number))
            moved[..., :3] += 0.004 * noise * batch.is_free[..., None]
            batch = SceneBatch(moved, batch.scene_type)
        if number % 40 == 0:
            physics.make_ready(batch)
        elif number % 3:
            physics.feasibility(batch)
        else:
            physics.penetration(batch)

    return _flat(one, count, "calls")


def _play(env: gymnasium.Env[Any, Any], seed: int) -> None:
    env.reset(seed=seed)
    ended = False
    while not ended:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        ended = terminated or truncated


def _flat(one: Callable[[int], None], count: int, what: str) -> Figures:
    """Figures of ``count`` calls; ``silent`` is the number of quantities that rose, out of memory and descriptors."""
    figures, points = Figures(), []
    for point in range(_POINTS):
        for number in range(point * count // _POINTS, (point + 1) * count // _POINTS):
            one(number)
        gc.collect()
        points.append((_resident(), len(os.listdir("/proc/self/fd"))))
    figures.tried = count
    memory = [memory for memory, _ in points]
    slope = float(np.polyfit(np.arange(_POINTS // 2, _POINTS), memory[_POINTS // 2 :], 1)[0]) * _POINTS / count * 1000
    figures.measured = {
        "rss_mib": [round(value, 1) for value in memory],
        "descriptors": [descriptors for _, descriptors in points],
        f"mib_per_1000_{what}_second_half": round(slope, 3),
    }
    rose = memory[-1] - memory[_POINTS // 2 - 1] > _RISE
    opened = points[-1][1] > points[0][1]
    figures.silent = rose + opened
    if figures.silent:
        figures.note(f"not flat: {figures.measured}")
    return figures


def _resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
