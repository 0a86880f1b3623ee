"""Fixtures that several folders of tests share."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Iterator
from functools import partialmethod
from pathlib import Path
from typing import Any

import pytest
from PIL import Image


def pytest_collection_finish() -> None:
    """What takes seconds and is the same in many tests is made once per process."""
    _ranges_once()
    _wavefronts_once()
    _hulls_once()


def _wavefronts_once() -> None:
    """Text and texture of a drawn mesh, which trimesh writes."""
    placed = sys.modules.get("scene_envs.export.placed")
    if placed is None:  # nothing that was collected exports
        return
    write, known = placed.export_obj, {}

    def once(mesh: Any, **options: Any) -> Any:
        look, arrays = mesh.visual, (mesh.vertices, mesh.faces, mesh.vertex_normals, mesh.visual.uv)
        picture = look.material.image
        key = (look.material.name, repr(options), picture.size, picture.tobytes(), *(a.tobytes() for a in arrays))
        if key not in known:
            known[key] = write(mesh, **options)
        text, others = known[key]
        return text, dict(others)

    placed.export_obj = once


def _hulls_once() -> None:
    """Inset hulls of convex parts, each from a linear program; processes that begin as copies know them as well."""
    parts = sys.modules.get("scene_envs.physics.parts")
    if parts is None:  # nothing that was collected simulates
        return
    inset, known = parts.inset_hull, {}

    def once(part: Any, distance: float) -> Any:
        key = (distance, part.normals.tobytes(), part.offsets.tobytes(), part.vertices.tobytes())
        if key not in known:
            known[key] = inset(part, distance)
        return known[key].copy()

    for name in ("parts", "bullet"):
        if module := sys.modules.get(f"scene_envs.physics.{name}"):
            module.inset_hull = once  # type: ignore[attr-defined]


def _ranges_once() -> None:
    """The ranges of a built-in grammar, on fewer objects."""
    ranges = sys.modules.get("scene_envs.datasets.generation")
    if ranges is None:  # nothing that was collected generates
        return
    from scene_envs.grammars.grammar import Grammar
    from scene_envs.scene_types import BUILT_IN

    names, measure = {scene_type.name for scene_type in BUILT_IN}, ranges._ranges
    known: dict[str, tuple[Any, Any, bool]] = {}

    def once(grammar: Any) -> tuple[Any, Any, bool]:
        if type(grammar) is not Grammar or grammar.name not in names:
            return measure(grammar)  # type: ignore[no-any-return]
        if grammar.name not in known:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(ranges, "_OBJECTS", 300)
                patch.setattr(ranges, "_STEP", 32)
                known[grammar.name] = measure(grammar)
        low, high, tilted = known[grammar.name]
        return low.clone(), high.clone(), tilted

    ranges._ranges = once


@pytest.fixture(autouse=True)
def _usual_logging() -> None:
    """Warnings reach the tests that read them, whatever a library of an earlier test set for all loggers."""
    if logging.root.level != logging.WARNING or logging.root.manager.disable:  # either call visits all loggers
        logging.root.setLevel(logging.WARNING)
        logging.disable(logging.NOTSET)
    for name, logger in logging.root.manager.loggerDict.items():
        if name.startswith(("scene_envs", "rewards", "agents")) and isinstance(logger, logging.Logger):
            logger.disabled, logger.propagate = False, True


@pytest.fixture(autouse=True)
def _coarse_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are drawn at a quarter of their width and height and enlarged, but where drawing itself is tested."""
    pictures = sys.modules.get("scene_envs.render.pictures")
    if pictures is None or request.path.parent.name == "render":
        return
    stages = sys.modules["scene_envs.render.stage"]
    draw, lamp = pictures.draw_picture, stages.light_camera

    def coarse(stage: Any, camera: Any, *scene: Any) -> Any:
        small = draw(stage, camera.resized(-(-camera.width // 4), -(-camera.height // 4)), *scene)
        return small.repeat(4, axis=0).repeat(4, axis=1)[: camera.height, : camera.width]

    def coarse_lamp(scene_type: Any) -> Any:
        camera = lamp(scene_type)
        return camera.resized(camera.width // 4, camera.height // 4)

    monkeypatch.setattr(pictures, "draw_picture", coarse)
    monkeypatch.setattr(stages, "light_camera", coarse_lamp)


@pytest.fixture(scope="session")
def _browser_of_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    from tests.helpers.browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def browser(_browser_of_session: Any) -> Any:
    """The browser of all tests, in a window of 700 x 560 pixels; drawing in software is what it takes its time for."""
    _browser_of_session.resize(700, 560)
    _browser_of_session.exceptions.clear()
    return _browser_of_session


@pytest.fixture
def coarse_browser(browser: Any) -> Any:
    """The same with a quarter of the pixels, for tests of what a page does and not of its picture."""
    browser.resize(700, 560, sharpness=0.5)
    return browser


@pytest.fixture
def new_interpreters(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers start as users have them: new interpreters, which know nothing of this process."""
    monkeypatch.setattr("scene_envs.workers.subprocess", subprocess)


@pytest.fixture
def few_grammar_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run on ``data=grammar`` draws 32 scenes for its moments and its vocabulary, and holds 32 out."""
    monkeypatch.setattr("agents.pretraining.initial_prior._SAMPLE", 32)
    monkeypatch.setattr("agents.pretraining.initial_prior._HELD_OUT", 32)


@pytest.fixture
def blank_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves of runs are composed and not rastered, which is half of a small run's time; a blank PNG is written."""

    def blank(figure: object, path: Path) -> None:
        Image.new("L", (1, 1)).save(path)

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", blank)


@pytest.fixture(scope="module")
def few_residual_levels() -> Iterator[None]:
    """After pretraining, the error of the denoiser is measured at 3 timesteps and not at 40, as long as a small run."""
    from agents.priors.continuous import ContinuousPrior
    from agents.priors.mixed import MixedPrior

    with pytest.MonkeyPatch.context() as patch:
        for kind in (ContinuousPrior, MixedPrior):
            patch.setattr(kind, "fit_residual", partialmethod(kind.fit_residual, levels=3))
        yield
