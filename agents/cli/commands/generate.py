"""``scene-envs generate``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from agents.cli.run_folder import Run
from agents.configuration.composition import ProgressKeys, named, require_one_of


@dataclass
class GenerateConfig(ProgressKeys):
    """A dataset from a grammar.

    Attributes:
        scene: scene type whose grammar is used.
        count: number of scenes to keep.
        seed: seed of the grammar; the same seed and shard_size give the same dataset.
        workers: worker processes; 0 uses this process. With Ray, the number of CPUs of a cluster that this command
            starts.
        verify: keep only scenes that pass physics.
        physics: engine of motion: bullet, mujoco, warp, or auto for bullet where it is installed, else mujoco.
        shard_size: scenes per parquet file.
        backend: processes, for processes of this machine, or ray.
        address: address of a running Ray cluster; null starts one on this machine.
        output: the dataset folder; finished shards found there are kept.
    """

    scene: Any = named("dimsum_table", "scene")
    count: int = 1000
    seed: int = 0
    workers: int = 2
    physics: str = "auto"
    verify: bool = True
    shard_size: int = 2000
    backend: str = "processes"
    address: str | None = None
    output: str = ""


def check(settings: GenerateConfig) -> None:
    """Refuse impossible settings before anything is imported."""
    require_one_of(settings, "backend", ("processes", "ray"))


def run(settings: GenerateConfig, run: Run) -> None:
    """Write the dataset into ``output``."""
    from scene_envs.datasets import generate

    keys = dict(vars(settings))
    report = generate(keys.pop("scene"), **keys)
    run.write_metrics({**asdict(report), "output": str(report.output)})
    run.say(f"{report.scenes} scenes of {report.tried} tried, in {report.seconds:.0f} s: {report.output}")
