"""Prompts that samples follow, with and without claim guidance, as a table.

python benchmarks/claim_guidance.py [--priors dimsum_table,living_room_shelf_feasible] [--kinds relations,count,names]
    [--count 128] [--strength 2] [--physics-guidance 1] [--picture PATH]

*Both* is the mean over scenes of the feasible share, 0 where the prompt is not followed.

The prompts describe scenes of the grammar. Both rows of a prior and a kind have the same prompts and the same noise.
``--picture`` draws the scenes of the first prior and kind: without guidance above, with guidance below.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from agents import ScenePrior
from rewards import RewardContext, make_reward
from scene_envs import SceneBatch, get_grammar
from scene_envs.datasets import describe, parse_prompt, scene_facts
from scene_envs.datasets.prompts.claims import SideClaim
from scene_envs.render import gallery, picture_camera, render

_COLUMNS = (
    "prior", "prompts", "claim guidance", "followed", "at places", "on or in one thing", "on things of a name", "sides",
    "next to", "feasible share", "both", "scenes per second",
)  # fmt: skip
CLASSES = ("PlaceCount", "SupportCount", "PairCount", "side", "next")
_SHOWN = 4


def main() -> None:
    """Sample, print the table and draw the picture."""
    arguments = _arguments()
    print("| " + " | ".join(_COLUMNS) + " |")
    print("|---" * len(_COLUMNS) + "|")
    for name in arguments.priors.split(","):
        prior = ScenePrior.load(name)
        scenes = get_grammar(prior.scene_type.name).sample(np.random.default_rng(7), arguments.count)
        for kind in arguments.kinds.split(","):
            prompts = describe(scenes, np.random.default_rng(7), kinds=[kind])
            drawn = []
            for strength in (0.0, arguments.strength):
                started = time.process_time()
                batch = prior.sample(
                    arguments.count, prompt=prompts, guidance=arguments.guidance, claim_guidance=strength,
                    physics_guidance=arguments.physics_guidance, seed=3,
                )  # fmt: skip
                row = _row(batch, prompts, time.process_time() - started)
                print(f"| `{name}` | {kind} | {strength:g} | {row} |", flush=True)
                drawn.append(batch[:_SHOWN])
            if arguments.picture is not None:
                print("\n".join(prompts[:_SHOWN]))
                _draw(drawn, arguments.picture)
                return


def _row(batch: SceneBatch, prompts: list[str], seconds: float) -> str:
    held: dict[str, list[bool]] = defaultdict(list)
    followed = []
    for prompt, facts in zip(prompts, scene_facts(batch), strict=True):
        checks = parse_prompt(prompt, batch.scene_type).check(facts)
        followed.append(all(check.holds for check in checks))
        for check in checks:
            claim = check.claim
            side = isinstance(claim, SideClaim)
            kind = ("next" if claim.side == "next" else "side") if side else type(claim).__name__
            held[kind].append(check.holds)
    parts = [f"{np.mean(held[kind]):.0%} of {len(held[kind])}" if held[kind] else "" for kind in CLASSES]
    output = make_reward("feasible_share")(batch, RewardContext())
    share = output.value.numpy()
    both = float(np.mean(share * np.array(followed)))
    return " | ".join(
        [f"{np.mean(followed):.0%}", *parts, f"{share.mean():.1%}", f"{both:.1%}", f"{len(batch) / seconds:.1f}"]
    )


def _draw(drawn: list[SceneBatch], path: Path) -> None:
    scenes = SceneBatch.concatenate([batch[index : index + 1] for batch in drawn for index in range(len(batch))])
    camera = picture_camera(scenes.scene_type.name, 400, 300)
    gallery(render(scenes, camera=camera, width=400, height=300), columns=_SHOWN).save(path)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--priors", default="dimsum_table", help="names or folders of priors, joined by commas")
    parser.add_argument("--kinds", default="relations", help="kinds of prompts: relations, count, names")
    parser.add_argument("--count", type=int, default=128, help="prompts of each prior and kind")
    parser.add_argument("--strength", type=float, default=2.0, help="claim_guidance of the second row")
    parser.add_argument("--physics-guidance", type=float, default=0.0, help="physics_guidance of all rows")
    parser.add_argument("--guidance", type=float, default=0.0, help="weight of classifier-free guidance")
    parser.add_argument(
        "--picture", type=Path, default=None, help="picture of the first scenes; nothing else is sampled"
    )
    return parser.parse_args()


if __name__ == "__main__":
    main()
