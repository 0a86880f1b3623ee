"""``scene-envs project``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from agents.cli.commands.scenes import draw_scenes, make_ready
from agents.cli.run_folder import Run
from scene_envs.errors import Checked, Count, InvalidInputError, Natural


@dataclass
class ProjectConfig(Checked):
    """Scenes made simulation-ready.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a sample or search run, or a dataset.
        count: number of scenes, from the first; null for all.
        pictures: number of scenes in the galleries; 0 draws none.
        workers: physics worker processes; 0 computes physics in this process.
        physics: engine of motion: bullet, mujoco, warp, or auto for bullet where it is installed, else mujoco.
        output: folder for ready.safetensors, before.png and ready.png.
    """

    scenes: str = ""
    count: Count | None = None
    pictures: Natural = 12
    workers: Natural = 2
    physics: str = "auto"
    output: str = ""


def check(settings: ProjectConfig) -> None:
    """Refuse settings that name no scenes."""
    if not settings.scenes:
        raise InvalidInputError("project: name a scene file, run or dataset, as in scenes=runs/mine")


def run(settings: ProjectConfig, run: Run) -> None:
    """Project and settle the scenes, and count the ready objects."""
    from scene_envs.datasets import load_scenes
    from scene_envs.physics import make_pool

    batch = load_scenes(Path(settings.scenes), settings.count)
    with make_pool(settings.workers, physics=settings.physics) as pool:
        draw_scenes(batch, settings.pictures, run, "before.png")
        run.write_metrics({"scenes": len(batch), "ready": make_ready(batch, settings.pictures, pool, run)})
    run.say(f"written to {run.directory}")
