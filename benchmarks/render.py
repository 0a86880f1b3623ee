"""Milliseconds per image of the renderer and of PyBullet's TinyRenderer, and the size of a viewer, per scene type.

    python benchmarks/render.py [--count 8] [--seed 0] [--rounds 2]

Scenes come from the grammars. Images are 640 x 480, by the three-quarter camera of pictures: depth and instances, all
images of sensors but the lit picture, and the lit picture. TinyRenderer makes a picture without shadows, depth and
instances at once. Times are CPU milliseconds of one thread, the least of rounds in turn, without the making of bodies.
The viewer holds 16 scenes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.grammars import get_grammar
from scene_envs.render import observe, picture_camera, render, write_viewer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, list_scene_types

try:
    import pybullet
except ImportError:  # it has wheels for Python 3.10 and 3.11
    pybullet = None


class TinyRenderer:
    """PyBullet's renderer in software, with the bodies of each scene in use."""

    def __init__(self, camera: Camera) -> None:
        self.client = pybullet.connect(pybullet.DIRECT)
        self.shapes: dict[int, int] = {}
        distance = float(np.linalg.norm(np.subtract(camera.position, camera.target)))
        view = pybullet.computeViewMatrix(camera.position, camera.target, camera.up)
        aspect = camera.width / camera.height
        lens = pybullet.computeProjectionMatrixFOV(camera.fov_y, aspect, 0.1 * distance, 10.0 * distance)
        self.view = {"width": camera.width, "height": camera.height, "viewMatrix": view, "projectionMatrix": lens}

    def place(self, scene: SceneBatch) -> list[int]:
        """Bodies of the one scene."""
        from scene_envs.rotations import matrix_to_quaternion

        bodies = []
        for slot in np.flatnonzero(~scene.is_empty[0].numpy()).tolist():
            mesh = scene.scene_type.library[category := int(scene.categories[0, slot])].visual
            if category not in self.shapes:
                arrays = {"vertices": mesh.vertices, "indices": mesh.faces.ravel(), "normals": mesh.vertex_normals}
                lists = {name: values.tolist() for name, values in arrays.items()}
                self.shapes[category] = pybullet.createVisualShape(pybullet.GEOM_MESH, **lists)
            w, x, y, z = matrix_to_quaternion(scene.rotations[0, slot].double()).tolist()
            place = scene.translations[0, slot].tolist()
            shape = self.shapes[category]
            bodies.append(pybullet.createMultiBody(0, -1, shape, place, (x, y, z, w)))
        return bodies

    def draw(self) -> None:
        pybullet.getCameraImage(**self.view, shadow=0, renderer=pybullet.ER_TINY_RENDERER)


def tiny_seconds(tiny: TinyRenderer, batch: SceneBatch) -> float:
    """CPU seconds of TinyRenderer for all scenes."""
    seconds = 0.0
    for index in range(len(batch)):
        bodies = tiny.place(batch[index : index + 1])
        start = time.process_time()
        tiny.draw()
        seconds += time.process_time() - start
        for body in bodies:
            pybullet.removeBody(body)
    return seconds


def seconds_of(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    titles = ("depth, instance (ms)", "all sensors (ms)", "picture (ms)", "TinyRenderer (ms)", "viewer (MB)")
    table = Table("scene type", "objects", *titles)
    for name in list_scene_types():
        scenes = get_grammar(name).sample(np.random.default_rng(options.seed), max(16, options.count))
        batch = scenes[: options.count]
        camera = picture_camera(batch.scene_type, 640, 480)
        works = [
            lambda batch=batch, camera=camera: seconds_of(lambda: observe(batch, [camera], ["depth", "instance"])),
            lambda batch=batch, camera=camera: seconds_of(
                lambda: observe(batch, [camera], ["depth", "instance", "boxes", "category", "normals"])
            ),
            lambda batch=batch, camera=camera: seconds_of(lambda: render(batch, camera=camera)),
        ]
        if pybullet is not None:
            tiny = TinyRenderer(camera)
            works.append(lambda batch=batch, tiny=tiny: tiny_seconds(tiny, batch))
        render(batch, width=32, height=24)  # makes the bodies
        rounds = [[work() for work in works] for _ in range(options.rounds)]
        cells = [f"{1e3 * least / len(batch):.0f}" for least in np.min(rounds, axis=0)]
        if pybullet is None:
            cells.append("-")
        else:
            pybullet.disconnect(tiny.client)
        with tempfile.TemporaryDirectory() as folder:
            size = write_viewer(scenes[:16], Path(folder) / "viewer.html").stat().st_size
        table.add_row(name, f"{batch.counts.double().mean():.0f}", *cells, f"{size / 1e6:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
