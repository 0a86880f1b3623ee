"""Another scene in every environment of mjlab: a robot arm at tables that are all laid differently.

    pip install mjlab
    scene-envs sample prior=dimsum_table count=64 project=true export=worlds output=runs/tables
    python examples/worlds_mjlab.py runs/tables/export/worlds.npz num_envs=64 device=cuda:0

makes the environments of mjlab's task of a YAM arm that lifts a cube, attaches the model of the scenes to theirs, and
gives each environment a scene of its own. A reset puts the objects back. On a CPU it runs too, slowly: ``num_envs=2``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from worlds import fill, world_fields

PREFIX = "scene/"
AT = (0.75, 0.0, 0.0)
"""Where the middle of the table top is, m: the arm stands at the origin, beside the table."""


def attach(spec: Any, path: str | Path) -> None:
    """Add the bodies of the worlds to the specification of an environment."""
    scenes = mujoco.MjSpec.from_file(str(Path(path).with_suffix(".xml")))
    for key in spec.keys:  # their lengths would be those of an environment without the scenes
        spec.delete(key)
    spec.attach(scenes, prefix=PREFIX, frame=spec.worldbody.add_frame())


def environments(path: str | Path, num_envs: int, device: str, contacts: int = 500) -> Any:
    """``num_envs`` environments, each with another scene; two at least."""
    import mjlab.tasks  # noqa: F401
    import warp
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.tasks.registry import load_env_cfg

    cfg = load_env_cfg("Mjlab-Lift-Cube-Yam")
    cfg.scene.num_envs, cfg.scene.env_spacing = num_envs, 0.0  # environments do not see each other
    cfg.scene.spec_fn = lambda spec: attach(spec, path)
    cfg.sim.nconmax, cfg.sim.njmax = contacts, 4 * contacts
    cfg.sim.mujoco.cone, cfg.sim.mujoco.impratio, cfg.sim.mujoco.timestep = "elliptic", 10.0, 0.002
    env = ManagerBasedRlEnv(cfg, device=device)
    fields = world_fields(path, env.sim.mj_model, np.arange(num_envs) % len(np.load(path)["slots"]), PREFIX, AT)
    env.sim.expand_model_fields(tuple(fields))
    with warp.ScopedDevice(env.sim.wp_device):
        fill(env.sim.wp_model, fields)
    env.reset()
    return env


def main() -> None:
    """Make environments and step them."""
    import torch

    words = dict(word.split("=", 1) for word in sys.argv[2:])
    num_envs, steps = int(words.get("num_envs", 4)), int(words.get("steps", 5))
    env = environments(sys.argv[1], num_envs, words.get("device", "cpu"))
    names, model = np.load(sys.argv[1])["names"], env.sim.mj_model
    bodies = [index for index in range(model.nbody) if model.body(index).name.startswith((f"{PREFIX}o", f"{PREFIX}w"))]
    before = env.sim.data.xpos[:, bodies].clone()
    for _ in range(steps):
        env.step(torch.zeros(num_envs, env.action_manager.total_action_dim, device=env.device))
    way = (env.sim.data.xpos[:, bodies] - before).norm(dim=-1)
    for world in range(min(num_envs, 4)):
        objects = [name for name in names[world % len(names)] if name]
        print(f"environment {world}: {len(objects)} objects, moved by up to {1e3 * way[world].max():.2f} mm")


if __name__ == "__main__":
    main()
