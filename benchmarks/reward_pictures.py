"""Pictures of docs/rewards: for each reward, two scenes with different values.

python benchmarks/reward_pictures.py [--output docs/images] [REWARD ...]

Of twelve scenes, half of them disturbed, the ones with the lowest and the highest value are drawn.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents.post_training.discriminator import Discriminator
from rewards import LearnedReward, RewardContext, RewardOutput, evaluate_reward, resolve_reward
from scene_envs.grammars import get_grammar
from scene_envs.render import gallery, render
from scene_envs.scene import SceneBatch

Mark = Callable[[SceneBatch, RewardOutput], Tensor]


def credited(batch: SceneBatch, output: RewardOutput) -> Tensor:
    """(B, N) objects with credit."""
    return torch.zeros_like(batch.is_free) if output.per_object is None else output.per_object > 0


def without_credit(batch: SceneBatch, output: RewardOutput) -> Tensor:
    """(B, N) free objects with a credit below 0.5, which is half of that of an object at rest."""
    assert output.per_object is not None
    return batch.is_free & (output.per_object < 0.5)


@dataclass(frozen=True)
class Picture:
    """Settings of the picture of a reward.

    Attributes:
        reward: with its settings.
        scene_type: of the scenes.
        noise: standard deviation (m) of the disturbance of every other scene.
        red: what the red objects are.
        mark: which objects are red; none when it is None.
    """

    reward: Any
    scene_type: str
    noise: float = 0.0
    red: str = ""
    mark: Mark | None = None


def trained_discriminator() -> LearnedReward:
    """A discriminator that has learned to tell dim sum tables from tables disturbed by 1 cm."""
    grammar, reward = get_grammar("dimsum_table"), Discriminator()
    other = grammar.sample(np.random.default_rng(2), 128)
    noise = 0.01 * torch.randn(other.translations.shape, generator=torch.Generator().manual_seed(2))
    reward.begin(grammar.sample(np.random.default_rng(1), 128), seed=0)
    reward.learn(other.with_poses(other.translations + noise * other.is_free[..., None], other.rotations), steps=150)
    return reward


FRUIT = {"name": "category_count", "assets": "fruit"}
NAMED = {"name": "prompt_match", "prompt": "A scene with a table, two cups and four plates."}
PICTURES = {
    "object_count": Picture("object_count", "breakfast_table_high_clutter"),
    "clutter": Picture("clutter", "pantry_shelf"),
    "penetration": Picture(
        "penetration", "dimsum_table", 0.02, "overlapping", lambda b, o: o.object_flags["overlapping"] & b.is_free
    ),
    "feasible_objects": Picture("feasible_objects", "dimsum_table", 0.004, "not feasible", without_credit),
    "feasible_share": Picture("feasible_share", "breakfast_table_high_clutter", 0.003, "not feasible", without_credit),
    "stability": Picture("stability", "dimsum_table", 0.008, "moves", without_credit),
    "category_count": Picture(FRUIT, "pantry_shelf", 0.0, "fruit", credited),
    "prompt_match": Picture(NAMED, "dimsum_table"),
    "reachability": Picture("reachability", "dimsum_table", 0.0, "not reached", without_credit),
    "clearance": Picture("clearance", "dimsum_table", 0.01, "crowded", lambda b, o: o.object_flags["crowded"]),
    "discriminator": Picture(trained_discriminator, "dimsum_table", 0.01, "probability below 0.5", without_credit),
}
COUNT = 12


def scenes_of(picture: Picture) -> SceneBatch:
    """Generated scenes, every other one disturbed."""
    batch = get_grammar(picture.scene_type).sample(np.random.default_rng(0), COUNT)
    noise = picture.noise * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    noise *= batch.is_free[..., None] * (torch.arange(COUNT) % 2)[:, None, None]
    return batch.with_poses(batch.translations + noise, batch.rotations)


def draw(name: str, picture: Picture, folder: Path) -> None:
    """The scenes with the lowest and the highest value, side by side."""
    batch = scenes_of(picture)
    reward = picture.reward() if picture.reward is trained_discriminator else resolve_reward(picture.reward)
    output = evaluate_reward(reward, batch, RewardContext(), strict=True)
    value = output.value.masked_fill(~output.is_valid, torch.nan)
    images, captions = [], []
    for row in (int(np.nanargmin(value)), int(np.nanargmax(value))):
        red = None if picture.mark is None else picture.mark(batch, output)[row : row + 1]
        images.append(render(batch[row], width=400, height=300, highlight=red)[0])
        captions.append(f"{round(float(value[row]), 3) + 0.0:.3g}" + (f"; red: {picture.red}" if picture.red else ""))
    path = folder / f"reward_{name}.png"
    gallery(images, columns=2, captions=captions).save(path, optimize=True)
    print(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rewards", nargs="*", metavar="REWARD")
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    for name in arguments.rewards or PICTURES:
        draw(name, PICTURES[name], arguments.output)


if __name__ == "__main__":
    main()
