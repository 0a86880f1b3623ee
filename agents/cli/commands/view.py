"""``scene-envs view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.cli.commands.scenes import draw, draw_scenes, load_prior, object_counts
from agents.cli.run_folder import Run
from agents.configuration.composition import DrawKeys, named
from scene_envs.errors import Count, InvalidInputError, Natural
from scene_envs.files import find_scenes, is_dataset

if TYPE_CHECKING:
    from scene_envs.scene import SceneBatch


@dataclass
class ViewConfig(DrawKeys):
    """Scenes in a browser.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a run that holds scenes, a dataset folder or a
            .parquet file.
        prior: prior from which samples are drawn: a shipped name, or the folder of a prior or a run.
        scene: scene type from whose grammar scenes are drawn; with scenes=, the type of a dataset that names none.
        count: number of scenes to show.
        first: the first scene of scenes= to show, counted from 0.
        seed: seed of the grammar or the prior.
        title: heading of the page; null for a heading that names the source of the scenes.
        pictures: number of scenes in gallery.png; 0 draws none.
        open: also open the page in the browser.
        output: folder for viewer.html and gallery.png.
    """

    scenes: str = ""
    prior: str = ""
    scene: Any = named("", "scene")
    count: Count = 16
    first: Natural = 0
    title: str | None = None
    pictures: Natural = 12
    open: bool = False
    output: str = ""


def check(settings: ViewConfig) -> None:
    """Refuse settings that name no source of scenes, or two."""
    if settings.scenes and settings.prior:
        raise InvalidInputError("view: give either scenes= or prior=, not both")
    if settings.prior and settings.scene:
        raise InvalidInputError("view: give either prior= or scene=, not both; a prior knows its scene type")
    if not (settings.scenes or settings.prior or settings.scene):
        raise InvalidInputError(
            "view: say what to show: scenes=FILE or FOLDER, prior=NAME, or scene=TYPE, as in view prior=dimsum_table"
        )


def run(settings: ViewConfig, run: Run) -> None:
    """Write the page, and say where it is."""
    from scene_envs.render import write_viewer

    batch, captions, title, has_more = _gather(settings)
    path = write_viewer(batch, run.directory / "viewer.html", captions=captions, title=settings.title or title)
    draw_scenes(batch, settings.pictures, run, "gallery.png")
    size = path.stat().st_size
    run.write_metrics({"scenes": len(batch), "objects": object_counts(batch), "bytes": size})
    others = ", the others are left out (count=, first=)" if has_more or settings.first else ""
    run.say(f"{len(batch)} scenes, {size / 1e6:.1f} MB{others}; open in any browser: {path}")
    if settings.open:
        import webbrowser

        if not webbrowser.open(path.resolve().as_uri()):
            run.say("no browser was found to open it in")


def _gather(settings: ViewConfig) -> tuple[SceneBatch, list[str] | None, str, bool]:
    """The scenes to show, their captions if they have any, a title, and whether there are more scenes."""
    if settings.scenes:
        return _read(settings)
    if settings.prior:
        batch = draw(load_prior(settings), settings, settings.count)
        return batch, None, f"Samples of {Path(settings.prior).name}", False
    import numpy as np

    from scene_envs.grammars import get_grammar

    batch = get_grammar(settings.scene).sample(np.random.default_rng(settings.seed), settings.count)
    return batch, None, f"Grammar {settings.scene}", False


def _read(settings: ViewConfig) -> tuple[SceneBatch, list[str] | None, str, bool]:
    """Scenes ``first`` to ``first + count`` of a scene file or a dataset, whose captions are its prompts."""
    from scene_envs.datasets import SceneDataset, load_scenes

    path = find_scenes(Path(settings.scenes))
    chosen = slice(settings.first, settings.first + settings.count)
    if not is_dataset(path):
        everything, captions = load_scenes(path), None
        total, batch = len(everything), everything[chosen]
        if settings.scene not in ("", batch.scene_type.name):
            raise InvalidInputError(
                f"view: the scenes of {str(path)!r} are of type {batch.scene_type.name!r}, not scene={settings.scene}; "
                "leave scene= out"
            )
    else:
        dataset = SceneDataset.load(path, scene_type=settings.scene or None, limit=chosen.stop + 1)
        total, captions = len(dataset), dataset.prompts[chosen]
        batch = dataset.batch(chosen)
    if len(batch) == 0:
        raise InvalidInputError(f"view: first={settings.first} is beyond the {total} scenes of {str(path)!r}")
    title = path.name if path.suffix == ".parquet" or path.is_dir() else path.parent.name
    return batch, captions, title, total > chosen.stop
