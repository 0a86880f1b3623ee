"""``scene-envs rearrange``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from agents.cli.commands.complete import load_prior_and_scenes, save_scenes

if TYPE_CHECKING:
    from agents.cli.run_folder import Run


@dataclass
class RearrangeConfig:
    """The same objects at new poses; what is welded stays.

    Attributes:
        scenes: a scene file, the folder of a sample or project run (its simulation-ready scenes if it has any), or
            a dataset.
        prior: a shipped name, or the folder of a prior or a run; empty means the shipped prior of the scene type.
        count: how many of the scenes, from the first; null for all.
        prompt: what the whole scenes should hold, for priors that read prompts; null for anything.
        guidance: weight of classifier-free guidance, 0 for none; needs a prompt.
        num_steps: denoising steps per scene.
        seed: of the noise.
        pictures: how many scenes the galleries show; 0 draws none.
        device: torch device.
        output: folder for scenes.safetensors, before.png and gallery.png.
    """

    scenes: str = ""
    prior: str = ""
    count: int | None = None
    prompt: str | None = None
    guidance: float = 0.0
    num_steps: int = 50
    seed: int = 0
    pictures: int = 12
    device: str = "cpu"
    output: str = ""


def config() -> type[RearrangeConfig]:
    """The keys of this command."""
    return RearrangeConfig


def run(settings: RearrangeConfig, run: Run) -> None:
    """New poses for the free objects."""
    prior, batch = load_prior_and_scenes("rearrange", settings.scenes, settings.prior, settings.count, settings.device)
    moved = prior.rearrange(
        batch, prompt=settings.prompt, guidance=settings.guidance, num_steps=settings.num_steps, seed=settings.seed
    ).to("cpu")
    distance = (moved.translations - batch.translations).norm(dim=-1)[batch.is_free]
    figures = {"mean_distance_m": float(distance.double().mean()) if len(distance) else 0.0}
    run.say(f"{len(batch)} scenes, objects moved by {figures['mean_distance_m']:.3f} m on average")
    save_scenes(batch, moved, settings.pictures, run, figures)
