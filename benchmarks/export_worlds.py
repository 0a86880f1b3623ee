"""Size and time of exports of the format ``worlds``, and how far their worlds are from each scene's own MJCF.

    python benchmarks/export_worlds.py [--count 4096] [--compared 8] [--scene NAME ...] [--picture worlds.png]
        [--looks looks.png]

Scenes are drawn from the grammar of each type, 256 different ones, which repeat. Printed are bodies and geometries of
the model, the size of the files, and CPU time of the export; then, of some scenes, in MuJoCo C: worlds with the same
contacts at the start, and the median and largest difference of a position after 0.1 s. The picture shows 16 worlds of a
Dimsum Table, from the arrays; that of ``--looks`` shows 16 with drawn colours, textures, light and camera, as MuJoCo
draws them (``MUJOCO_GL=egl`` without a display).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from runpy import run_path

import mujoco
import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.export import export
from scene_envs.grammars import get_grammar
from scene_envs.render import gallery, render
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, list_scene_types

LOOKS = {
    "color": {"uniform": [0.3, 1.0]},
    "texture": {"choice": ["none", "none", "checker", "gradient", "flat"]},
    "light_direction": {"normal": [0.0, 0.25]},
    "light_intensity": {"uniform": [0.5, 2.5]},
    "light_color": {"uniform": [0.6, 1.0]},
    "camera_position": {"uniform": [-0.5, 0.5]},
    "camera_target": {"normal": [0.0, 0.03]},
    "camera_fov_y": {"uniform": [-8.0, 4.0]},
}
EXAMPLE = run_path(str(Path(__file__).parents[1] / "examples" / "worlds.py"))


def difference(folder: Path, world: int) -> tuple[bool, float]:
    """Whether a world has the contacts of the scene's own file at the start, and the difference after 0.1 s, m."""
    own = mujoco.MjModel.from_xml_path(str(folder / f"scene_{world:03d}" / "scene.xml"))
    data = mujoco.MjData(own)
    model, state = EXAMPLE["mujoco_world"](folder / "worlds.npz", world)
    mujoco.mj_forward(own, data)
    mujoco.mj_forward(model, state)
    same = data.ncon == state.ncon and np.allclose(np.sort(data.contact.dist), np.sort(state.contact.dist), atol=1e-12)
    mujoco.mj_step(own, data, 50)
    mujoco.mj_step(model, state, 50)
    names = np.load(folder / "worlds.npz")["names"][world]
    way = [np.abs(state.xpos[body] - data.body(name).xpos).max() for body, name in enumerate(names, start=1) if name]
    return same, max(way)


def scenes_of(path: Path) -> SceneBatch:
    """The scenes of an array file."""
    arrays = np.load(path)
    batch = SceneBatch.empty(get_scene_type(str(arrays["scene_type"])), len(arrays["slots"]), arrays["slots"].max() + 1)
    parts = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    for world, column in np.argwhere(arrays["slots"] >= 0):
        turn = np.zeros(9)
        slot = arrays["slots"][world, column]
        mujoco.mju_quat2Mat(turn, arrays["world/body_quat"][world, 1 + column])
        parts[0][world, slot] = torch.from_numpy(arrays["world/body_pos"][world, 1 + column])
        parts[1][world, slot] = torch.from_numpy(turn.reshape(3, 3))
        parts[2][world, slot] = int(arrays["categories"][world, column])
    return SceneBatch.from_parts(*parts, batch.scene_type)


def seen(path: Path, world: int) -> np.ndarray:
    """(180, 240, 3): what the camera of a world sees, as MuJoCo draws it."""
    model, state = EXAMPLE["mujoco_world"](path, world)
    mujoco.mj_forward(model, state)
    option = mujoco.MjvOption()
    option.geomgroup[3] = 0  # not the convex parts
    with mujoco.Renderer(model, 180, 240) as renderer:
        renderer.update_scene(state, "scene", option)
        return renderer.render()


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--count", type=int, default=4096)
    parser.add_argument("--compared", type=int, default=8)
    parser.add_argument("--scene", nargs="*", default=list_scene_types())
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--looks", type=Path)
    options = parser.parse_args()
    table = Table(
        "scenes", "bodies", "geometries", "npz, MB", "all files, MB", "CPU s", "same contacts", "after 0.1 s, m"
    )
    for name in options.scene:
        drawn = get_grammar(name).sample(np.random.default_rng(0), min(256, options.count))
        batch = SceneBatch.concatenate([drawn] * -(-options.count // len(drawn)))[: options.count]
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            report = export(batch, Path(folder) / "all", "worlds")
            seconds = time.process_time() - start
            arrays = Path(folder) / "all" / "worlds.npz"
            model = EXAMPLE["compiled"](arrays)
            export(drawn[: options.compared], Path(folder) / "few", ["mjcf", "worlds"])
            found = [difference(Path(folder) / "few", world) for world in range(min(options.compared, len(drawn)))]
            sizes = f"{arrays.stat().st_size / 1e6:.1f}", f"{report.size / 1e6:.1f}"
        same = f"{sum(one for one, _ in found)} of {len(found)}"
        ways = [way for _, way in found]
        row = [name, f"{model.nbody}", f"{model.ngeom}", *sizes, f"{seconds:.1f}"]
        table.add_row(*row, same, f"{np.median(ways):.0e}, {max(ways):.0e}")
    Console().print(table)
    if options.picture:
        with tempfile.TemporaryDirectory() as folder:
            drawn = get_grammar("dimsum_table").sample(np.random.default_rng(0), 16)
            export(drawn, folder, "worlds")
            shown = scenes_of(Path(folder) / "worlds.npz")
        picture = gallery(list(render(shown, width=240, height=180)), columns=4)
        picture.quantize(128).save(options.picture, optimize=True)
    if options.looks:
        with tempfile.TemporaryDirectory() as folder:
            drawn = get_grammar("dimsum_table").sample(np.random.default_rng(0), 16)
            export(drawn, folder, "worlds", randomization=LOOKS)
            images = [seen(Path(folder) / "worlds.npz", world) for world in range(16)]
        gallery(images, columns=4).quantize(128).save(options.looks, optimize=True)


if __name__ == "__main__":
    main()
