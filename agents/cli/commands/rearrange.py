"""``scene-envs rearrange``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agents.cli.commands.inpainting import InpaintingConfig, check, load_prior_and_scenes, save_scenes

if TYPE_CHECKING:
    from agents.cli.run_folder import Run

__all__ = ["check", "run"]


def run(settings: InpaintingConfig, run: Run) -> None:
    """Give the free objects new poses; welded objects stay."""
    prior, batch = load_prior_and_scenes("rearrange", settings)
    moved = settings.in_parts(batch, lambda part, keys: prior.rearrange(part, **keys))
    distance = (moved.translations - batch.translations).norm(dim=-1)[batch.is_free]
    figures = {"mean_distance_m": float(distance.double().mean()) if len(distance) else 0.0}
    run.say(f"{len(batch)} scenes, objects moved by {figures['mean_distance_m']:.3f} m on average")
    save_scenes(batch, moved, settings.pictures, run, figures)
