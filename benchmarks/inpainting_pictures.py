"""Completion and rearrangement of scenes by shipped priors, as a picture and a table.

python benchmarks/inpainting_pictures.py [--output docs/images/inpainting.png] [--count 32]

Real scenes of the grammar lose a random half of their free objects; the prior completes what is left. It also gives new
poses to all free objects of the whole scenes. A row of the picture is one scene of one prior: the real scene, its half,
the half completed, the whole rearranged. No scene is selected. The table has means over ``--count`` scenes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from agents import ScenePrior
from scene_envs import SceneBatch
from scene_envs.grammars import get_grammar
from scene_envs.physics import feasibility
from scene_envs.render import gallery, picture_camera, render

PRIORS = ("dimsum_table_completion", "living_room_shelf_feasible", "pantry_shelf_feasible")
COLUMNS = ("real scene", "a half of its objects", "the half completed", "the whole rearranged")


def main() -> None:
    """Inpaint, print the table and draw the picture."""
    arguments = _arguments()
    print("| prior | scenes | free objects | feasible |")
    print("|---|---|---|---|")
    images, captions = [], []
    for name in PRIORS:
        prior = ScenePrior.load(name)
        real = get_grammar(prior.scene_type.name).sample(np.random.default_rng(0), arguments.count)
        real = real.with_slots(prior.config.slots)
        half = _half(real)
        scenes = (real, half, prior.complete(half, physics_guidance=0.0), prior.rearrange(real, physics_guidance=0.0))
        for title, batch in zip(COLUMNS, scenes, strict=True):
            print(_row(name, title, batch))
        camera = picture_camera(prior.scene_type.name, 320, 240)
        images += list(
            render(SceneBatch.concatenate([batch[:1] for batch in scenes]), camera=camera, width=320, height=240)
        )
        captions += COLUMNS
    gallery(images, columns=len(COLUMNS), captions=captions).save(arguments.output)


def _half(batch: SceneBatch) -> SceneBatch:
    """The scenes without a random half of their free objects."""
    draws = torch.rand(batch.is_free.shape, generator=torch.Generator().manual_seed(0))
    rank = torch.where(batch.is_free, draws, 2.0).argsort(dim=1).argsort(dim=1)
    gone = batch.is_free & (rank < batch.is_free.sum(dim=1, keepdim=True) // 2)
    tensor = torch.where(gone[..., None], SceneBatch.empty(batch.scene_type, 1, 2).tensor[:, 1:], batch.tensor)
    return SceneBatch(tensor, batch.scene_type)


def _row(prior: str, title: str, batch: SceneBatch) -> str:
    report = feasibility(batch)
    free = batch.is_free.sum()
    share = float((report.feasible & batch.is_free).sum() / free)
    return f"| `{prior}` | {title} | {float(free) / len(batch):.1f} | {share:.1%} |"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images/inpainting.png"), help="the picture")
    parser.add_argument("--count", type=int, default=32, help="scenes of each prior")
    return parser.parse_args()


if __name__ == "__main__":
    main()
