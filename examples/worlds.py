"""Another scene in every parallel world: load an export of the format ``worlds`` and step it.

    scene-envs sample prior=dimsum_table count=64 project=true export=worlds output=runs/tables
    python examples/worlds.py runs/tables/export/worlds.npz

steps all worlds at once with MuJoCo Warp (``pip install mujoco-warp``), each with its own scene: on a GPU where there
is one (4,096 worlds: nworld=4096), else on the CPU. Kernels are compiled on the first run, for about a minute. The file
needs no part of SceneEnvs: copy the loaders where you need them.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np


def world_fields(path: str | Path) -> dict[str, Any]:
    """Fields of MuJoCo's model (W, ...), a row for each world, from ``worlds.npz``."""
    with np.load(path) as file:
        fields = {key[6:]: file[key] for key in file if key.startswith("world/")}
        return fields | {key[5:]: file[key][fields["geom_dataid"]] for key in file if key.startswith("mesh/")}


def mujoco_world(path: str | Path, index: int) -> tuple[Any, Any]:
    """Model and data of world ``index`` in MuJoCo."""
    model = mujoco.MjModel.from_xml_path(str(Path(path).with_suffix(".xml")))
    for name, rows in world_fields(path).items():
        getattr(model, name)[:] = rows[index]
    absent = model.geom_dataid < 0
    model.geom_contype[absent] = model.geom_conaffinity[absent] = model.geom_rgba[absent] = 0
    model.geom_sameframe[:] = 0  # no geometry is in the frame of its body
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # the trees of boxes are of the compiled meshes
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)  # the mass matrix at the start
    model.stat.meaninertia = model.dof_M0.mean()  # the scale of the solver's tolerance
    mujoco.mj_resetData(model, data)
    return model, data


def warp_worlds(path: str | Path, nworld: int, contacts: int = 400) -> tuple[Any, Any]:
    """Model and data of ``nworld`` worlds in MuJoCo Warp; scenes repeat if there are more worlds. There is room for
    ``contacts`` per world on average.
    """
    import mujoco_warp
    import warp

    model = mujoco.MjModel.from_xml_path(str(Path(path).with_suffix(".xml")))
    m = mujoco_warp.put_model(model)
    for name, rows in world_fields(path).items():
        rows = rows[np.arange(max(2, nworld)) % len(rows)]  # one row alone would be taken for the same in all worlds
        field = getattr(m, name)
        shape = rows.shape if name != "geom_aabb" else (*rows.shape[:-1], 2, 3)
        setattr(m, name, warp.array(rows.reshape(shape), dtype=field.dtype))
    d = mujoco_warp.make_data(model, nworld=nworld, nconmax=contacts, njmax=4 * contacts)
    mujoco_warp.reset_data(m, d)  # poses of all objects from qpos0, body_pos and body_quat of their world
    return m, d


def main() -> None:
    """Step worlds and say how fast."""
    import mujoco_warp
    import warp

    words = dict(word.split("=", 1) for word in sys.argv[2:])
    nworld, steps = int(words.get("nworld", 16)), int(words.get("steps", 50))
    m, d = warp_worlds(sys.argv[1], nworld)
    before = d.qpos.numpy()
    mujoco_warp.step(m, d)  # compiles the kernels
    warp.synchronize()
    start = time.perf_counter()
    if d.qpos.device.is_cuda:
        with warp.ScopedCapture() as capture:
            mujoco_warp.step(m, d)
        for _ in range(steps - 1):
            warp.capture_launch(capture.graph)
    else:
        for _ in range(steps - 1):
            mujoco_warp.step(m, d)
    seconds, after = max(time.perf_counter() - start, 1e-9), d.qpos.numpy()
    way = np.linalg.norm((after - before).reshape(nworld, -1, 7)[..., :3], axis=2).max(axis=1)
    print(f"{nworld} worlds, {steps} steps: {nworld * (steps - 1) / seconds:.0f} steps a second")
    print(f"largest way of an object: {1e3 * np.median(way):.2f} mm in the median world, {1e3 * way.max():.2f} in one")
    if d.overflow.numpy().any():
        sys.exit("contacts or constraints were left out: give warp_worlds more contacts")


if __name__ == "__main__":
    main()
