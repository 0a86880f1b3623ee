"""Checks of scene_envs on Python versions beside that of .venv, without torch. Usage: .venv/bin/python .ci/smoke.py

Makes an environment in build/ for each of the versions whose interpreter is on this machine, with the newest packages
that pyproject.toml allows, and runs the checks there; versions without interpreter are named and left out. All versions
run at the same time. An environment is made again when the packages in pyproject.toml have changed. Torch has no small
wheel for every version, so what needs it is left out: batches of scenes, grammars, environments, priors, training and
commands. Exit status 1 when a check failed.

    python .ci/smoke.py check    # the checks alone, in the current environment
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSIONS = ("3.12", "3.13")
PACKAGES = (
    *("gymnasium", "numpy", "scipy", "trimesh", "mujoco", "python-fcl"),
    *("pillow", "pyyaml", "rich", "jinja2", "markupsafe"),
)
"""Dependencies of scene_envs without torch; ``EXTRA`` is of the tests."""
EXTRA = ("usd-core",)
ENGINE = "mujoco"
"""Engine of these versions, for which PyBullet has no wheels."""
LIMIT = 300.0
"""Seconds for each step of a version."""


def check_geometry() -> str:
    """Collision parts have volume and a possible inertia, and meshes lie in the same box as the parts."""
    import numpy as np

    from scene_envs.scene_types import BUILT_IN

    assets = {asset.name: asset for scene_type in BUILT_IN for asset in scene_type.library}
    for asset in assets.values():
        assert all(np.isfinite(part.vertices).all() and len(part.faces) >= 4 for part in asset.fine), asset.name
        low, high = (np.array([getattr(p.vertices, side)(axis=0) for p in asset.fine]) for side in ("min", "max"))
        np.testing.assert_allclose([low.min(axis=0), high.max(axis=0)], asset.visual.bounds, atol=0.02)
        if asset.mass:
            moments = np.linalg.eigvalsh(asset.inertia)
            assert moments[0] > 0, asset.name
            assert moments[0] + moments[1] > moments[2] * (1 - 1e-9), asset.name
    return f"{len(assets)} assets of {len(BUILT_IN)} scene types"


def _chunk(*objects: tuple[str, float, float, float]):
    """A dim sum table with objects (asset, x, y, z) m, as workers receive it."""
    import numpy as np

    from scene_envs.physics.kernels import Chunk
    from scene_envs.scene_types import get_scene_type

    table = get_scene_type("dimsum_table")
    (fixed,) = table.fixed
    placed = [(fixed.asset, *fixed.translation), *objects]
    translations = np.array([[place for _, *place in placed]], dtype=np.float64)
    categories = np.array([[table.assets.index(name) for name, *_ in placed]])
    return Chunk(table, translations, np.tile(np.eye(3), (1, len(placed), 1, 1)), categories)


def check_overlap() -> str:
    """Dishes 1 mm apart do not overlap; a cup that is 3 mm too low overlaps by 3 mm."""
    from scene_envs.physics.kernels import penetration_kernel
    from scene_envs.scene_types import get_scene_type

    top = float(get_scene_type("dimsum_table").library["serving_dish"].bounds[1, 2])
    clear = penetration_kernel(
        _chunk(("serving_dish", 0.0, 0.0, 0.0), ("serving_dish", 0.0, 0.0, top + 0.001)), engine=ENGINE
    )
    low = penetration_kernel(_chunk(("serving_dish", 0.0, 0.0, 0.0), ("teacup", 0.3, 0.0, -0.003)), engine=ENGINE)
    assert clear["depth"].max() < 1e-5, clear
    assert abs(low["depth"][0, 2] - 0.003) < 1e-4, low
    return f"a cup 3 mm in the table overlaps by {1e3 * low['depth'][0, 2]:.3f} mm"


def check_projection() -> str:
    """Projection lifts that cup out again."""
    from scene_envs.physics.kernels import penetration_kernel, projection_kernel

    chunk = _chunk(("teacup", 0.3, 0.0, -0.003))
    moved = projection_kernel(chunk, engine=ENGINE)["translations"]
    chunk.translations[:] = moved
    assert penetration_kernel(chunk, engine=ENGINE)["depth"].max() < 1e-4
    return f"lifted by {1e3 * (moved[0, 1, 2] + 0.003):.2f} mm"


def check_motion() -> str:
    """A dish 5 cm above the table, tilted by 17 degrees, falls and lies flat."""
    import numpy as np

    from scene_envs.physics.engines import engine_name
    from scene_envs.physics.kernels import settle_kernel

    assert engine_name("auto") == ENGINE
    chunk = _chunk(("serving_dish", 0.2, 0.0, 0.05))
    chunk.rotations[0, 1] = [[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]]
    found = settle_kernel(chunk, engine=ENGINE, duration=2.0, iterations=50)
    assert found["valid"].all()
    assert abs(found["translations"][0, 1, 2]) < 1e-3, found
    assert found["rotations"][0, 1, 2, 2] > 0.9999, found
    return f"rests {1e3 * found['translations'][0, 1, 2]:.3f} mm above the table"


def check_pictures() -> str:
    """A table and a dish seen from above are as far away, and as large, as the pinhole equations say."""
    import numpy as np

    from scene_envs.render import Pinhole
    from scene_envs.render.stage import get_stage

    chunk = _chunk(("serving_dish", 0.1, 0.0, 0.0))
    stage = get_stage(chunk.scene_type.assets, chunk.scene_type.asset_folders)
    stage.place(chunk.translations[0], chunk.rotations[0], chunk.categories[0])
    camera = Pinhole.at((0.1, 0.0, 1.5), (0.1, 0.0, 0.0), (1.0, 0.0, 0.0), 30.0, 320, 240)
    frame = stage.look(camera)
    rows, columns = np.nonzero(frame.slots == 1)
    points = camera.rays(columns + 0.5, rows + 0.5) * frame.depth[rows, columns, None]
    faces, light = frame.faces[rows, columns], np.array([0.0, 0.0, 1.0])
    color = stage.paint(camera, faces, points, stage.normals(camera), light)
    seen = frame.slots == 1
    mesh = chunk.scene_type.library["serving_dish"].visual
    nearest = 1.5 - mesh.bounds[1, 2]
    assert abs(np.median(frame.depth[frame.slots == 0]) - 1.5) < 1e-5
    rows = np.flatnonzero(seen.any(axis=1))
    expected = 120.0 / np.tan(np.radians(15.0)) * mesh.extents[0] / nearest
    assert abs(rows[-1] - rows[0] + 1 - expected) < 4.0, (rows, expected)
    assert color.mean() > 60.0
    return f"{int(seen.sum())} pixels of a dish"


def check_exports() -> str:
    """A scene loads in MuJoCo and USD with its poses and masses."""
    import mujoco
    import numpy as np
    from pxr import Usd

    from scene_envs.export import mjcf, usd
    from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene

    chunk = _chunk(("teacup", 0.3, 0.0, 0.0), ("teapot", -0.2, 0.1, 0.0))
    table = chunk.scene_type
    objects = tuple(
        PlacedObject(
            f"object_{slot}", asset := table.library[category], slot, category, place, np.eye(3), slot == 0,
            asset.mass, asset.inertia, 0.6,
        )
        for slot, (category, place) in enumerate(zip(chunk.categories[0].tolist(), chunk.translations[0], strict=True))
    )  # fmt: skip
    scene = PlacedScene(0, table, len(objects), objects)
    with tempfile.TemporaryDirectory() as folder:
        files = AssetFiles(Path(folder) / "assets", scene.assets, 0.6, "smoke")
        (Path(folder) / "scene").mkdir()
        model = mujoco.MjModel.from_xml_path(str(mjcf.write_scene(scene, files, Path(folder) / "scene")))
        for item in objects[1:]:
            body = model.body(item.name)
            np.testing.assert_allclose(body.pos, item.translation, atol=1e-12)
            np.testing.assert_allclose(body.mass, item.asset.mass, rtol=1e-9)
        stage = Usd.Stage.Open(str(usd.write_scene(scene, files, Path(folder) / "scene")))
        names = {prim.GetName() for prim in stage.Traverse()}
        assert {item.name for item in objects} <= names, names
    return f"MuJoCo {mujoco.__version__}, USD {'.'.join(map(str, Usd.GetVersion()))}"


CHECKS: tuple[Callable[[], str], ...] = (
    check_geometry,
    check_overlap,
    check_projection,
    check_motion,
    check_pictures,
    check_exports,
)


def check() -> int:
    """Run every check in this environment."""
    failed = 0
    for run in CHECKS:
        started, name = time.perf_counter(), run.__name__.removeprefix("check_")
        try:
            print(f"  {name}: {run()} ({time.perf_counter() - started:.1f} s)", flush=True)
        except Exception:
            failed += 1
            print(f"  {name} FAILED\n{traceback.format_exc()}", flush=True)
    print("  left out without torch: batches of scenes, grammars, environments, priors, training, commands")
    return min(failed, 1)


def interpreter(version: str) -> str | None:
    """An interpreter of this Python version; names on the path may be empty shims."""
    found = [shutil.which(f"python{version}"), *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))]
    for path in filter(None, found):
        shown = subprocess.run([path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], capture_output=True)
        if shown.stdout.decode().strip() == version:
            return path
    return None


def requirements() -> list[str]:
    """The lines of pyproject.toml for the packages that are installed."""
    import re

    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [(line, PACKAGES) for line in project["dependencies"]]
    lines += [(line, EXTRA) for line in project["optional-dependencies"]["dev"]]
    return [line for line, names in lines if re.split(r"[^\w-]", line)[0] in names]


def smoke(version: str, python: str) -> tuple[int, str]:
    """Exit status and output of the checks in the environment of this version."""
    started, folder = time.perf_counter(), ROOT / "build" / f"smoke-{version}"
    own, installed, packages = str(folder / "bin/python"), folder / "installed", requirements()
    check = [own, __file__, "check"]
    make = [python, "-m", "venv", "--clear", str(folder)]
    pip = [own, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile", *packages]
    fresh = not installed.exists() or installed.read_text(encoding="utf-8") != repr(packages)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    for command in (make, pip, check) if fresh else (check,):
        try:
            done = subprocess.run(
                command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=LIMIT
            )
        except subprocess.TimeoutExpired:
            return 1, f"Python {version}: longer than {LIMIT:.0f} s at: {' '.join(command)}"
        if done.returncode:
            break
        if command is pip:
            installed.write_text(repr(packages), encoding="utf-8")
    return done.returncode, f"Python {version}, {time.perf_counter() - started:.0f} s:\n{done.stdout.rstrip()}"


def main() -> int:
    """Run the checks in each version that this machine has."""
    found = {version: interpreter(version) for version in VERSIONS}
    for version in (version for version, path in found.items() if path is None):
        print(f"Python {version} is not on this machine: left out")
    with ThreadPoolExecutor() as threads:
        results = list(threads.map(lambda item: smoke(*item), [(v, path) for v, path in found.items() if path]))
    for _, text in results:
        print(text)
    return max((status for status, _ in results), default=0)


if __name__ == "__main__":
    sys.exit(check() if sys.argv[1:] == ["check"] else main())
