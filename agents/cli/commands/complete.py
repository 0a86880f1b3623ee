"""``scene-envs complete``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from agents.cli.commands.inpainting import InpaintingConfig, check, load_prior_and_scenes, save_scenes

if TYPE_CHECKING:
    from agents.cli.run_folder import Run

__all__ = ["check", "run"]


@dataclass
class CompleteConfig(InpaintingConfig):
    """Completion of scenes; their objects stay bit-identical.

    Attributes:
        slots: slots of the result; null keeps the number of the scenes.
        fill: most objects to add to a scene; null for as many as there are empty slots.
    """

    slots: int | None = None
    fill: int | None = None


def run(settings: CompleteConfig, run: Run) -> None:
    """Fill the empty slots."""
    prior, batch = load_prior_and_scenes("complete", settings)
    filled = settings.in_parts(
        batch, lambda part, keys: prior.complete(part, slots=settings.slots, fill=settings.fill, **keys)
    )
    added = float((filled.counts - batch.counts).double().mean())
    run.say(f"{len(batch)} scenes, {added:.1f} objects added on average")
    save_scenes(batch, filled, settings.pictures, run, {"added": added})
