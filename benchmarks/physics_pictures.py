"""Pictures of docs/physics.md: one scene for each function of the physics.

python benchmarks/physics_pictures.py [--output docs/images]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scene_envs.grammars import get_grammar
from scene_envs.physics import equilibrium, feasibility, penetration, project, settle
from scene_envs.render import gallery, render
from scene_envs.scene import SceneBatch


def noisy(name: str, index: int, scale: tuple[float, float, float], seed: int = 0) -> SceneBatch:
    """One generated scene whose free objects were moved by Gaussian noise of ``scale`` m per axis."""
    batch = get_grammar(name).sample(np.random.default_rng(seed), index + 1)[index]
    noise = torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(seed))
    noise *= torch.tensor(scale) * batch.is_free.unsqueeze(-1)
    return batch.with_poses(batch.translations + noise, batch.rotations)


def save(path: Path, panels: list[tuple[str, SceneBatch, Tensor | None]]) -> None:
    """Panels side by side: caption, scene, and which objects are red."""
    images = [render(batch, width=480, height=360, highlight=marked)[0] for _, batch, marked in panels]
    gallery(images, columns=len(panels), captions=[caption for caption, _, _ in panels]).save(path)
    print(path)


def mean_way(before: SceneBatch, after: SceneBatch) -> float:
    """Mean distance (mm) of free objects between two poses of one scene, at most half a metre each."""
    way = (after.translations - before.translations).norm(dim=-1)[before.is_free]
    return 1e3 * float(way.clamp(max=0.5).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("docs/images"))
    folder: Path = parser.parse_args().output
    folder.mkdir(parents=True, exist_ok=True)

    scene = noisy("breakfast_table_high_clutter", 2, (0.012, 0.012, 0.0))
    depth = penetration(scene).depth
    deepest = 1e3 * float(depth.max())
    save(
        folder / "physics_penetration.png",
        [
            ("given", scene, None),
            (f"red: deeper than 1 mm (deepest {deepest:.0f} mm)", scene, (depth > 1e-3) & scene.is_free),
        ],
    )

    scene = noisy("living_room_shelf", 7, (0.0, 0.0, 0.012), seed=2)
    moved = equilibrium(scene).displacement
    save(
        folder / "physics_equilibrium.png",
        [("given", scene, None), ("red: moves by more than 1 mm in 0.1 s", scene, (moved > 1e-3) & scene.is_free)],
    )

    scene = noisy("dimsum_table", 1, (0.012, 0.012, 0.0005))
    verdict = feasibility(scene)
    save(
        folder / "physics_feasibility.png",
        [
            (f"{int(verdict.counts)} of {int(scene.is_free.sum())} objects are feasible", scene, None),
            ("red: overlap, or lose their support", scene, scene.is_free & ~verdict.feasible),
        ],
    )

    scene = noisy("breakfast_table_high_clutter", 6, (0.02, 0.02, 0.01))
    projected = project(scene)
    inside = (penetration(scene).depth > 1e-3) & scene.is_free
    mean = 1e3 * float(projected.moved[scene.is_free].mean())
    save(
        folder / "physics_project.png",
        [
            ("given; red: overlap", scene, inside),
            (f"projected: moved by {mean:.0f} mm on average", projected.batch, None),
        ],
    )

    scene = noisy("breakfast_table_low_clutter", 3, (0.0, 0.0, 0.0))
    higher = scene.translations.clone()
    higher[..., 2] += 0.05 * scene.is_free
    lifted = scene.with_poses(higher, scene.rotations)
    save(folder / "physics_settle.png", [("5 cm above", lifted, None), ("settled", settle(lifted).batch, None)])

    scene = noisy("dimsum_table", 5, (0.01, 0.01, 0.01))
    alone = settle(scene, duration=2.0).batch
    both = settle(project(scene).batch, duration=2.0).batch
    save(
        folder / "physics_ablation.png",
        [
            ("given: 1 cm of noise", scene, None),
            (f"simulation alone: {mean_way(scene, alone):.0f} mm", alone, None),
            (f"projection, then simulation: {mean_way(scene, both):.0f} mm", both, None),
        ],
    )


if __name__ == "__main__":
    main()
