"""MuJoCo Warp: overlap verdicts and feasibility per second of Dimsum scenes, agreement with MuJoCo C, time to compile.

    python -m benchmarks.worlds [--device cuda] [--counts 1024 4096] [--checked 48] [--out worlds.json]

The scenes are generated and have Gaussian noise of 2 mm sideways and 0.4 mm in height on every free object, as samples
of a good prior have. They are on the device before the clock starts. *Feasibility* is overlaps, removal of objects that
overlap by more than 1 mm, and 0.1 s of motion. Kernels are compiled into an empty folder: *cold* is the first call,
*warm* the first call of another process that finds them there.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.feasibility import NOISE, disturbed
from scene_envs.export import export
from scene_envs.grammars import get_grammar
from scene_envs.physics.warp import TIMESTEP, WarpEngine, warp_engine
from scene_envs.rotations import geodesic_angle, quaternion_to_matrix
from scene_envs.scene import SceneBatch

DURATION, MAX_DEPTH, MAX_MOVE, MAX_TURN = 0.1, 1e-3, 1e-3, 1e-2


def scenes(count: int, device: str) -> SceneBatch:
    """``count`` noisy scenes of 64 generated ones."""
    base = get_grammar("dimsum_table").sample(np.random.default_rng(0), 64)
    repeated = base[torch.arange(count) % len(base)]
    return disturbed(repeated, *NOISE["precise"], torch.Generator().manual_seed(0)).to(device)


def without_deep(engine: WarpEngine, batch: SceneBatch) -> SceneBatch:
    """The scenes without objects that overlap by more than a millimetre."""
    found = engine.overlaps(batch)
    deep = found.depth > MAX_DEPTH
    gone = torch.zeros_like(batch.is_empty)
    for slot in (found.first, found.second):
        gone[found.scene[deep], slot[deep]] = True
    categories = batch.categories.masked_fill(gone & batch.is_free, batch.scene_type.num_assets)
    return SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type)


def moved(batch: SceneBatch, translations: Tensor, rotations: Tensor) -> Tensor:
    """(B, N) bool: free objects that moved or turned further than the limits."""
    far = (translations - batch.translations).norm(dim=-1) > MAX_MOVE
    identity = torch.eye(3, device=far.device)
    one, two = (torch.where(batch.is_free[..., None, None], r, identity) for r in (batch.rotations, rotations))
    return batch.is_free & (far | (geodesic_angle(one, two) > MAX_TURN))


def moved_in_mujoco(batch: SceneBatch) -> Tensor:
    """The same verdicts by MuJoCo C, of the scenes exported as MJCF."""
    translations, rotations = batch.translations.clone(), batch.rotations.clone()
    with tempfile.TemporaryDirectory() as folder:
        for index, files in enumerate(export(batch, folder, "mjcf").scenes):
            model = mujoco.MjModel.from_xml_path(str(files["mjcf"]))
            data = mujoco.MjData(model)
            mujoco.mj_step(model, data, nstep=round(DURATION / TIMESTEP))
            end = torch.from_numpy(data.qpos.reshape(-1, 7))
            translations[index, batch.is_free[index]] = end[:, :3].float()
            rotations[index, batch.is_free[index]] = quaternion_to_matrix(end[:, 3:]).float()
    return moved(batch, translations, rotations)


def seconds(device: str, work: Callable[..., object], *arguments: object) -> float:
    """Seconds that a call takes, until the device is done."""
    start = time.perf_counter()
    work(*arguments)
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return time.perf_counter() - start


def first_calls(device: str) -> dict[str, float]:
    """Seconds of the first overlaps and of the first motion of this process; imports are not counted."""
    batch, engine = scenes(32, device), warp_engine(scenes(1, "cpu").scene_type, device)
    return {
        "overlaps": seconds(device, engine.overlaps, batch),
        "motion": seconds(device, engine.simulate, batch, 2 * TIMESTEP),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--counts", type=int, nargs="+", default=[1024, 4096], help="scenes per batch")
    parser.add_argument("--checked", type=int, default=48, help="scenes that MuJoCo C simulates, too")
    parser.add_argument("--out", default="worlds.json")
    parser.add_argument("--first-calls", action="store_true", help="print the seconds of the first calls and end")
    options = parser.parse_args()
    if options.first_calls:
        print(json.dumps(first_calls(options.device)))
        return
    device, found = options.device, {}
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARP_CACHE_PATH"] = folder
        command = [sys.executable, "-m", "benchmarks.worlds", "--first-calls", "--device", device]
        for name in ("cold", "warm"):
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            found.update(
                {f"{key}, first call {name} (s)": s for key, s in json.loads(done.stdout.splitlines()[-1]).items()}
            )
        engine = warp_engine(scenes(1, "cpu").scene_type, device)
        for count in options.counts:
            batch = scenes(count, device)
            kept = without_deep(engine, batch)  # loads the kernels
            engine.simulate(kept, TIMESTEP)
            overlaps = min(seconds(device, engine.overlaps, batch) for _ in range(3))
            motion = seconds(device, engine.simulate, kept, DURATION)
            removal = seconds(device, without_deep, engine, batch)
            found[f"overlap verdicts/s, {count} scenes"] = count / overlaps
            found[f"feasibility verdicts/s, {count} scenes"] = count / (removal + motion)
        kept = without_deep(engine, scenes(options.checked, device))
        translations, rotations, valid = engine.simulate(kept, DURATION)
        differs = moved(kept, translations, rotations).cpu() != moved_in_mujoco(kept.to("cpu"))
        found["objects compared with MuJoCo C"] = int((kept.is_free & valid[:, None]).sum())
        found["verdicts on motion that differ"] = int((differs & valid.cpu()[:, None]).sum())
    table = Table("what", "value", title=torch.cuda.get_device_name() if device.startswith("cuda") else device)
    for name, value in found.items():
        table.add_row(name, f"{value:,.1f}" if isinstance(value, float) else f"{value:,}")
    Console().print(table)
    Path(options.out).write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
