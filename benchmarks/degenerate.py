"""Time of physics, rewards and search on degenerate scenes, such as all objects at one point, in pairs or nested.

    python benchmarks/degenerate.py [TYPE ...] [--count 2] [--seed 0] [--one-asset] [--physics auto]

The scenes are the heaps of ``projection.py --heaps``, in which random assets take all slots of a type. Two kinds are
added: four pairs of objects, in each of which a corner of the upper object stands on a corner of the lower one, and a
scene with a NaN. The prompt of rewards is written for an ordinary scene of the type, on which every function must give
a result. *search* is the evaluation of a root with the objective `feasible_objects`. Each row is printed as soon as it
is known, with the CPU time of the slowest of ``--count`` scenes; at the end follows the largest time of each function.
A star: the scene was refused with an error of this package, or its row is invalid. An exclamation mark: the result is
not finite.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable
from functools import partial

import gymnasium as gym
import numpy as np
import torch
from projection import HEAPS, heap
from scipy.spatial.transform import Rotation

from rewards import Reward, RewardContext, RewardOutput, evaluate_reward, make_reward
from rewards.feasible import forget_verdicts
from scene_envs.datasets.prompts import describe
from scene_envs.errors import SceneEnvsError
from scene_envs.grammars import get_grammar
from scene_envs.physics import equilibrium, feasibility, make_pool, make_ready, penetration, project, settle
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

Function = Callable[[SceneBatch], object]

REWARDS = {
    "object_count": make_reward("object_count"),
    "feasible_objects": make_reward("feasible_objects"),
    "prompt_match": make_reward("prompt_match"),
    "clip": make_reward("clip", reward="feasible_objects", high=3.0),
    "product": make_reward("product", rewards=["object_count", "feasible_objects"]),
    **{name: make_reward(name) for name in ("feasible_share", "clutter", "stability", "reachability")},
    "penetration (reward)": make_reward("penetration"),
    "weighted_sum": make_reward("weighted_sum", rewards=["object_count", "feasible_objects"], weights=[1.0, 1.0]),
}
PHYSICS: dict[str, Function] = {
    "penetration": penetration,
    "feasibility": feasibility,
    "equilibrium": equilibrium,
    "project": project,
    "settle": settle,
    "make_ready": make_ready,
}


def on_corners(name: str, rng: np.random.Generator) -> SceneBatch:
    """Four pairs of objects over the workspace, turned at random.

    In each pair, the highest corner of one object meets the lowest corner of the other.
    """
    batch = heap(name, "point", rng, one_asset=False)
    scene_type, slots = batch.scene_type, batch.is_free[0].nonzero()[:8, 0].tolist()
    low, high = (np.array(corner) for corner in scene_type.workspace)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    categories[0, batch.is_free[0]] = scene_type.num_assets
    for number, slot in enumerate(slots):
        asset = scene_type.library.assets[int(batch.categories[0, slot])]
        turn = Rotation.random(random_state=rng).as_matrix()
        corners = np.concatenate([part.vertices for part in asset.fine]) @ turn.T
        if number % 2 == 0:
            place = rng.uniform(low, high)
            meeting = place + corners[corners[:, 2].argmax()]
        else:
            place = meeting - corners[corners[:, 2].argmin()]
        translations[0, slot], rotations[0, slot] = torch.from_numpy(place).float(), torch.from_numpy(turn).float()
        categories[0, slot] = batch.categories[0, slot]
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def degenerate(name: str, kind: str, rng: np.random.Generator, *, one_asset: bool) -> SceneBatch:
    """One scene of a kind."""
    if kind == "corners":
        return on_corners(name, rng)
    if kind != "NaN":
        return heap(name, kind, rng, one_asset=one_asset)
    batch = get_grammar(name).sample(rng, 1)
    batch.tensor[0, int(batch.is_free[0].nonzero()[0, 0]), 1] = float("nan")
    return batch


def seconds(function: Function, batch: SceneBatch) -> tuple[float, str]:
    """CPU time of a call, and a mark for its outcome."""
    start = time.process_time()
    try:
        result = function(batch)
    except SceneEnvsError:
        return time.process_time() - start, "*"
    spent = time.process_time() - start
    valid = getattr(result, "valid", None)
    if valid is not None and not bool(valid.all()):
        return spent, "*"
    answer = result.batch.tensor if hasattr(result, "batch") else getattr(result, "value", torch.zeros(1))
    return spent, "" if bool(torch.isfinite(answer).all()) else "!"


def scored(batch: SceneBatch, reward: Reward, context: RewardContext) -> RewardOutput:
    """The output of a reward, computed without verdicts from earlier calls.

    Raises:
        RewardError: the reward failed.
    """
    forget_verdicts()
    return evaluate_reward(reward, batch, context, strict=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"of {', '.join(list_scene_types())}")
    parser.add_argument("--count", type=int, default=2, help="scenes per type and kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one-asset", action="store_true", help="all of the asset with most convex parts")
    parser.add_argument("--physics", default="auto", help="engine")
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.disable(logging.WARNING)
    names = [*PHYSICS, *REWARDS, "category_count", "search"]
    print(" | ".join(("scene type", "kind", *names)), flush=True)
    largest = dict.fromkeys(names, (0.0, ""))
    for name in options.types or list_scene_types():
        env = gym.make(
            "scene_envs:SceneEnvs/Search-v0", scene=name, objective="feasible_objects", num_steps=2,
            physics=options.physics,
        )  # fmt: skip
        clean = get_grammar(name).sample(np.random.default_rng(options.seed), 1)
        (prompt,) = describe(clean, np.random.default_rng(options.seed), kinds=["relations"])
        first = clean.scene_type.assets[int(clean.categories[clean.is_free][0])]
        rewards = REWARDS | {"category_count": make_reward("category_count", assets=[first])}
        context = RewardContext((prompt,), make_pool(0, physics=options.physics))
        functions = {key: partial(function, physics=options.physics) for key, function in PHYSICS.items()}
        functions |= {key: partial(scored, reward=reward, context=context) for key, reward in rewards.items()}
        functions["search"] = lambda batch, env=env: env.reset(seed=0, options={"scene": batch})
        for key, function in functions.items():  # builds what is needed
            if seconds(function, clean)[1]:
                raise SystemExit(f"{key} gives no result on an ordinary scene of {name}, so its time measures nothing")
        for kind in (*HEAPS, "corners", "NaN"):
            rng = np.random.default_rng(options.seed)
            batches = [degenerate(name, kind, rng, one_asset=options.one_asset) for _ in range(options.count)]
            cells = []
            for key, function in functions.items():
                slowest = max(seconds(function, batch) for batch in batches)
                cells.append(f"{slowest[0]:.2f}{slowest[1]}")
                largest[key] = max(largest[key], (slowest[0], f"{name}, {kind}"))
            print(" | ".join((name, kind, *cells)), flush=True)
        env.close()
    for key, (spent, where) in largest.items():
        print(f"largest of {key}: {spent:.2f} s ({where})")


if __name__ == "__main__":
    main()
