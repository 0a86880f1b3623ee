"""Walk by prompt from one scene type of the prior `cotrained` to another, as a picture and a table.

python benchmarks/prompt_walk.py [--output docs/images/prompt_walk.png] [--rows 3] [--union any]

The prior completes an empty shelf. Each column has one prompt, from the things of Living Room Shelf to those of
Pantry Shelf; each row has one seed. No sample is selected. The table says how many of ``--count`` samples follow
their prompt, and how many free objects are of assets that only one of the two types has.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from agents import ScenePrior
from scene_envs import SceneBatch, get_scene_type
from scene_envs.datasets import parse_prompt, scene_facts, to_union
from scene_envs.render import gallery, picture_camera, render

PROMPTS = (
    "A scene with a shelf, two board games, a lamp, a book and a speaker.",
    "A scene with a shelf, a board game, a lamp, a coke can and a pear.",
    "A scene with a shelf, a board game, two coke cans, two pears and an apple.",
    "A scene with a shelf, two coke cans, three pears and four apples.",
    "A scene with a shelf, three coke cans, five pears, six apples and two avocados.",
    "A scene with a shelf, four coke cans, eight pears, nine apples and five avocados.",
)
ENDS = ("living_room_shelf", "pantry_shelf")


def main() -> None:
    """Sample, print the table and draw the picture."""
    arguments = _arguments()
    prior = ScenePrior.load("cotrained").with_union(arguments.union)
    shelves = to_union(SceneBatch.empty(ENDS[0], arguments.count), prior.scene_type)
    walks = [
        prior.complete(shelves, prompt=prompt, guidance=arguments.guidance, num_steps=50, seed=0) for prompt in PROMPTS
    ]
    print("| prompt | free objects | of living room alone | of pantry alone | claims that hold | all hold |")
    print("|---|---|---|---|---|---|")
    for prompt, scenes in zip(PROMPTS, walks, strict=True):
        print(_row(prompt, scenes))
    shown = [walk[row : row + 1] for row in range(arguments.rows) for walk in walks]
    camera = picture_camera(ENDS[1], 320, 240)  # the shelf in view, wherever a stray object is
    images = render(SceneBatch.concatenate(shown), camera=camera, width=320, height=240)
    gallery(images, columns=len(PROMPTS)).save(arguments.output)


def _row(prompt: str, scenes: SceneBatch) -> str:
    names = scenes.scene_type.assets
    own = [set(get_scene_type(name).assets) for name in ENDS]
    free = scenes.is_free
    alone = []
    for first, second in (own, own[::-1]):
        of_one = torch.tensor([name in first - second for name in names] + [False])
        alone.append(float((of_one[scenes.categories] & free).sum(dim=1).float().mean()))
    claims = parse_prompt(prompt, scenes.scene_type)
    facts = scene_facts(scenes)
    share = sum(claims.score(fact) for fact in facts) / len(facts)
    whole = sum(claims.holds(fact) for fact in facts) / len(facts)
    objects = float(free.sum(dim=1).float().mean())
    return f"| {prompt} | {objects:.1f} | {alone[0]:.1f} | {alone[1]:.1f} | {share:.0%} | {whole:.0%} |"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images/prompt_walk.png"), help="the picture")
    parser.add_argument("--rows", type=int, default=3, help="rows of the picture")
    parser.add_argument("--count", type=int, default=16, help="samples per prompt")
    parser.add_argument("--guidance", type=float, default=0.0, help="weight of classifier-free guidance")
    parser.add_argument("--union", choices=("one_type", "any"), default="any", help="what a scene may hold")
    return parser.parse_args()


if __name__ == "__main__":
    main()
