"""``scene-envs project``, ``export`` and ``verify``."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any

from agents.cli.commands.scenes import draw, draw_scenes, load_prior, make_ready
from agents.cli.run_folder import Run
from agents.configuration.composition import DrawKeys, EngineKeys
from scene_envs.errors import Count, InvalidInputError, Natural, PhysicsError, at_least

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool
    from scene_envs.scene import SceneBatch

_OVERLAP = 1e-3
"""Overlap (m) above which a simulator visibly pushes objects apart."""


@dataclass
class ProjectConfig(EngineKeys):
    """Scenes made simulation-ready.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a sample or search run, or a dataset.
        count: number of scenes, from the first; null for all.
        pictures: number of scenes in the galleries; 0 draws none.
        output: folder for ready.safetensors, before.png and ready.png.
    """

    scenes: str = ""
    count: Count | None = None
    pictures: Natural = 12
    output: str = ""


@dataclass
class VerifyConfig:
    """Exported scenes, judged by every engine and simulator that is installed.

    Attributes:
        path: folder of an export, or of a run that holds one in export/. It gets verify.json and verify.txt.
    """

    path: str = "."


@dataclass
class ExportConfig(DrawKeys, EngineKeys):
    """Scenes for simulators and viewers.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a sample or project run (its simulation-ready
            scenes if it has any), or a dataset.
        prior: a prior from which scenes are drawn, in place of scenes=: a shipped name or a folder.
        formats: one or several of urdf, sdf, drake, mjcf, usd, glb, npz, worlds, written as [drake, mjcf]; all
            for every format with a file per scene whose packages are installed.
        count: number of scenes; null for all of them, or 16 from a prior.
        project: make the scenes simulation-ready first (project out of penetration, then settle).
        friction: coefficient of friction of all surfaces.
        randomization: YAML file with distributions of mass, friction, color, texture, light and camera; empty for none.
        output: folder for assets/ and scene_000/, scene_001/, ...
    """

    scenes: str = ""
    prior: str = ""
    formats: Any = "all"
    count: Count | None = None
    project: bool = False
    friction: Annotated[float, at_least(0)] = 0.6
    randomization: str = ""
    output: str = ""


def check(settings: ExportConfig) -> None:
    """Refuse impossible settings before scenes are read."""
    from scene_envs.export.formats import resolve_formats
    from scene_envs.export.randomization import read_randomization

    if bool(settings.scenes) == bool(settings.prior):
        raise InvalidInputError(
            "export: name either a scene file, run or dataset, as in scenes=runs/mine, or a prior, as in "
            "prior=dimsum_table"
        )
    resolve_formats(settings.formats)
    read_randomization(settings.randomization)


def run(settings: ExportConfig, run: Run) -> None:
    """Read or draw the scenes and write them."""
    from scene_envs.physics import make_pool

    batch = _scenes(settings, run)
    keys = {"friction": settings.friction, "randomization": settings.randomization}
    metrics: dict[str, Any] = {}
    with make_pool(settings.workers, physics=settings.physics) as pool:
        if settings.project:
            batch, metrics["ready"] = make_ready(batch, 0, pool, run)
        metrics |= export_scenes(batch, settings.formats, run.directory, pool, run, **keys)
    run.write_metrics(metrics)


def export_scenes(
    batch: SceneBatch, formats: Sequence[str], output: Path, pool: PhysicsPool, run: Run, **keys: Any
) -> dict[str, Any]:
    """Export into ``output``; say what was written and in how many scenes objects overlap; return the figures."""
    from scene_envs.export import export
    from scene_envs.physics import penetration

    started = time.perf_counter()
    report = export(batch, output, formats, **keys)
    seconds = time.perf_counter() - started
    size = f"{report.size / 1e6:.1f} MB"
    run.say(f"{len(batch)} scenes as {', '.join(report.formats)} in {output}: {size}, {seconds:.1f} s")
    for note in report.notes:
        run.say(note)
    overlapping = int((penetration(batch, pool=pool).depth.amax(dim=1) > _OVERLAP).sum()) if len(batch) else 0
    if overlapping:
        run.say(
            f"in {overlapping} of {len(batch)} scenes objects overlap by more than {_OVERLAP * 1e3:.0f} mm and will "
            "jump apart in a simulator; project=true makes scenes simulation-ready"
        )
    return {
        "scenes": len(batch),
        "overlapping": overlapping,
        "formats": list(report.formats),
        "assets": list(report.assets),
        "bytes": report.size,
        "seconds": round(seconds, 3),
    }


def keep_verified(batch: SceneBatch, formats: Sequence[str], run: Run, **keys: Any) -> SceneBatch:
    """The scenes that all judges find ready in an export with these keys; the verdicts on all go into the run."""
    from scene_envs.export import export, verify

    with tempfile.TemporaryDirectory(dir=run.directory) as folder:
        export(batch, folder, [*formats, "mjcf", "npz"], **keys)  # each scene has a judge, whatever is installed
        report = verify(folder)
        for name in ("verify.json", "verify.txt"):
            Path(folder, name).replace(run.directory / name)
    run.say(f"{report}; {report.ready.count(False)} dropped")
    return batch[[index for index, ready in enumerate(report.ready) if ready]]


def _scenes(settings: ExportConfig, run: Run) -> SceneBatch:
    """The scenes that ``scenes`` or ``prior`` names, at most ``count``."""
    if not settings.prior:
        from scene_envs.datasets import load_scenes

        return load_scenes(Path(settings.scenes), settings.count)
    batch = draw(load_prior(settings), settings, 16 if settings.count is None else settings.count)
    batch.save(run.directory / "scenes.safetensors")
    return batch


def run_verify(settings: VerifyConfig) -> None:
    """Print the verdicts; raises PhysicsError when a judge finds a scene that is not ready."""
    from scene_envs.export import verify

    report = verify(settings.path)
    print(report, flush=True)
    if not all(report.ready):
        raise PhysicsError(f"{report.ready.count(False)} of {len(report.scenes)} scenes are not ready for all judges")


def check_project(settings: ProjectConfig) -> None:
    """Refuse settings that name no scenes."""
    if not settings.scenes:
        raise InvalidInputError("project: name a scene file, run or dataset, as in scenes=runs/mine")


def run_project(settings: ProjectConfig, run: Run) -> None:
    """Project and settle the scenes, and count the ready objects."""
    from scene_envs.datasets import load_scenes
    from scene_envs.physics import make_pool

    batch = load_scenes(Path(settings.scenes), settings.count)
    with make_pool(settings.workers, physics=settings.physics) as pool:
        draw_scenes(batch, settings.pictures, run, "before.png")
        run.write_metrics({"scenes": len(batch), "ready": make_ready(batch, settings.pictures, pool, run)[1]})
    run.say(f"written to {run.directory}")


project = SimpleNamespace(run=run_project, check=check_project)
verify = SimpleNamespace(run=run_verify, WRITES=False, POSITIONAL=("path",))
