"""``scene-envs generate``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Any

from agents.cli.run_folder import Run
from agents.configuration.composition import EngineKeys, ProgressKeys, named
from scene_envs.errors import Count, Natural, OneOf, Seed


@dataclass
class GenerateConfig(EngineKeys, ProgressKeys):
    """A dataset from a grammar.

    Attributes:
        scene: scene type whose grammar is used.
        count: number of scenes to keep.
        seed: seed of the grammar; the same seed and shard_size give the same dataset.
        workers: worker processes; 0 uses this process. With Ray, the number of CPUs of a cluster that this command
            starts.
        verify: keep only scenes that pass physics.
        shard_size: scenes per parquet file.
        backend: processes, for processes of this machine, or ray.
        address: address of a running Ray cluster; null starts one on this machine.
        output: the dataset folder; finished shards found there are kept.
    """

    scene: Any = named("dimsum_table", "scene")
    count: Count = 1000
    seed: Seed = 0
    workers: Natural = 2
    verify: bool = True
    shard_size: Count = 2000
    backend: Annotated[str, OneOf(("processes", "ray"))] = "processes"
    address: str | None = None
    output: str = ""


def run(settings: GenerateConfig, run: Run) -> None:
    """Write the dataset into ``output``."""
    from scene_envs.datasets import generate

    keys = dict(vars(settings))
    report = generate(keys.pop("scene"), **keys)
    run.write_metrics({**asdict(report), "output": str(report.output)})
    run.say(f"{report.scenes} scenes of {report.tried} tried, in {report.seconds:.0f} s: {report.output}")
