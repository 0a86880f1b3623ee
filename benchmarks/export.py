"""Distances that objects move in simulators that load an export, beside the time and size of the export itself.

    python benchmarks/export.py [--scenes FILE | --scene dimsum_table] [--count 5] [--duration 1.0] [--seed 0]

Scenes are those of a file, such as the ready.safetensors of `scene-envs sample project=true`, or fresh ones of a
grammar. Each simulator that is installed loads them as docs/export.md says and runs for the duration. Printed is how
far the frames of free objects are from where they were exported: at load, and after the duration the median over
objects, the 95th percentile, and the largest.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from scene_envs.export import PlacedScene, export, list_formats, place
from scene_envs.scene import SceneBatch

Positions = dict[str, NDArray[np.float64]]
Simulate = Callable[[Path, PlacedScene, float], tuple[Positions, Positions]]
"""From an export folder, one of its scenes and a duration (s), object positions (3,) at load and afterwards."""


def mujoco(root: Path, scene: PlacedScene, duration: float) -> tuple[Positions, Positions]:
    import mujoco as mj

    model = mj.MjModel.from_xml_path(str(root / f"scene_{scene.index:03d}" / "scene.xml"))
    data = mj.MjData(model)

    def positions() -> Positions:
        mj.mj_forward(model, data)
        return {thing.name: data.body(thing.name).xpos.copy() for thing in scene.objects}

    before = positions()
    while data.time < duration:
        mj.mj_step(model, data)
    return before, positions()


def drake(root: Path, scene: PlacedScene, duration: float) -> tuple[Positions, Positions]:
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(root / "package.xml"))
    parser.AddModels(str(root / f"scene_{scene.index:03d}" / "scene.dmd.yaml"))
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_context())

    def positions() -> Positions:
        bodies = {t.name: plant.GetBodyIndices(plant.GetModelInstanceByName(t.name))[0] for t in scene.objects}
        return {
            name: plant.EvalBodyPoseInWorld(context, plant.get_body(body)).translation().copy()
            for name, body in bodies.items()
        }

    before = positions()
    simulator.AdvanceTo(duration)
    return before, positions()


def pybullet(root: Path, scene: PlacedScene, duration: float, key: str = "bullet_urdf") -> tuple[Positions, Positions]:
    import pybullet as bullet

    folder = root / f"scene_{scene.index:03d}"
    client = bullet.connect(bullet.DIRECT)
    bullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
    bodies = {
        thing["name"]: bullet.loadURDF(
            str(folder / thing[key]),
            thing["translation"],
            np.roll(thing["quaternion_wxyz"], -1).tolist(),
            useFixedBase=thing["welded"],
            flags=bullet.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
        for thing in json.loads((folder / "objects.json").read_text())["objects"]
    }

    def positions() -> Positions:
        found = {}
        for name, body in bodies.items():
            position, turn = bullet.getBasePositionAndOrientation(body, physicsClientId=client)
            center, axes = bullet.getDynamicsInfo(body, -1, physicsClientId=client)[3:5]
            rotation = Rotation.from_quat(turn) * Rotation.from_quat(axes).inv()
            found[name] = np.array(position) - rotation.apply(center)
        return found

    before = positions()
    for _ in range(round(240 * duration)):
        bullet.stepSimulation(physicsClientId=client)
    after = positions()
    bullet.disconnect(client)
    return before, after


SIMULATORS: dict[str, tuple[str, Simulate]] = {
    "MuJoCo": ("mujoco", mujoco),
    "Drake": ("pydrake", drake),
    "PyBullet": ("pybullet", pybullet),
    "PyBullet, exact parts": ("pybullet", lambda root, scene, duration: pybullet(root, scene, duration, "urdf")),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes")
    parser.add_argument("--scene", default="dimsum_table")
    parser.add_argument("--count", type=int, default=5)
    parser.add_argument("--duration", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.scenes:
        batch = SceneBatch.load(options.scenes)[: options.count]
    else:
        from scene_envs.grammars import get_grammar

        batch = get_grammar(options.scene).sample(np.random.default_rng(options.seed), options.count)
    scenes, console = place(batch), Console()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        table = Table("format", "first scene (s)", "each further (s)", "size of all (MB)", title=batch.scene_type.name)
        for name in list_formats():
            if name == "usd" and find_spec("pxr") is None:
                continue
            start = time.perf_counter()
            export(batch[:1], root / f"{name}_one", name)
            first = time.perf_counter() - start
            report = export(batch, root / name, name)
            rest = (time.perf_counter() - start - 2 * first) / max(1, len(batch) - 1)
            table.add_row(name, f"{first:.2f}", f"{max(rest, 0.0):.3f}", f"{report.size / 1e6:.2f}")
        console.print(table)
        export(batch, root / "all", ["urdf", "drake", "mjcf"])
        title = f"distance from the exported position (mm), {len(batch)} scenes"
        table = Table("simulator", "at load", "median", "95 %", "largest", "object", "s per scene", title=title)
        for label, (module, simulate) in SIMULATORS.items():
            if find_spec(module) is None:
                continue
            loaded, moved, names = [], [], []
            start = time.perf_counter()
            for scene in scenes:
                before, after = simulate(root / "all", scene, options.duration)
                for thing in scene.objects:
                    loaded.append(np.linalg.norm(before[thing.name] - thing.translation))
                    if not thing.welded:
                        moved.append(1e3 * np.linalg.norm(after[thing.name] - thing.translation))
                        names.append(f"{thing.name} of scene {scene.index}")
            seconds = (time.perf_counter() - start) / len(scenes)
            middle, high = np.percentile(moved, [50, 95])
            worst = int(np.argmax(moved))
            figures = [f"{middle:.3f}", f"{high:.3f}", f"{moved[worst]:.3f}", names[worst], f"{seconds:.1f}"]
            table.add_row(label, f"{1e3 * max(loaded):.0e}", *figures)
        console.print(table)


if __name__ == "__main__":
    main()
