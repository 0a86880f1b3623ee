"""CPU time per scene of every reward, on scenes of about 20 and about 60 objects.

python benchmarks/reward_costs.py [--scenes 4] [REWARD ...]

Dim sum tables with 19 to 22 objects and pantry shelves with 57 to 61, whose free objects are moved by 2 mm of noise per
axis. One warm-up call, then the process time of one call on all scenes together, over their number.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from rewards import RewardContext, evaluate_reward, learned_parts, list_rewards, resolve_reward
from rewards.feasible import forget_verdicts
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch

SIZES = {20: ("dimsum_table", 19, 22), 60: ("pantry_shelf", 57, 61)}
COMPOSITES = ("clip", "product", "weighted_sum")
PROMPT = "A scene where a cup is on top of the first plate from the left and the teapot is behind the cup."
SHELF_PROMPT = "A scene where three apples are on the top shelf and two pears are on the bottom shelf."


def scenes_of(size: int, count: int) -> SceneBatch:
    """``count`` disturbed scenes of about ``size`` objects."""
    name, least, most = SIZES[size]
    rng, found = np.random.default_rng(size), []
    while sum(map(len, found)) < count:
        batch = get_grammar(name).sample(rng, 32)
        found.append(batch[(batch.counts >= least) & (batch.counts <= most)])
    batch = SceneBatch.concatenate(found)[:count]
    noise = 0.002 * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(size))
    return batch.with_poses(batch.translations + noise * batch.is_free[..., None], batch.rotations)


def seconds(reward: Any, batch: SceneBatch) -> float:
    """CPU seconds per scene."""
    prompt = PROMPT if batch.scene_type.name == "dimsum_table" else SHELF_PROMPT
    context = RewardContext(prompts=(prompt,) * len(batch))
    resolved = resolve_reward(reward)
    for part in learned_parts(resolved):
        part.begin(batch, seed=0)
    evaluate_reward(resolved, batch, context, strict=True)
    forget_verdicts()
    start = time.process_time()
    evaluate_reward(resolved, batch, context, strict=True)
    return (time.process_time() - start) / len(batch)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rewards", nargs="*", metavar="REWARD")
    parser.add_argument("--scenes", type=int, default=4)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    batches = {size: scenes_of(size, arguments.scenes) for size in SIZES}
    table = Table("reward", *(f"{size} objects, ms" for size in SIZES))
    for name in arguments.rewards or [name for name in list_rewards() if name not in COMPOSITES]:
        table.add_row(name, *(f"{1e3 * seconds(name, batch):.3g}" for batch in batches.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
