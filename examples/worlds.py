"""Another scene in every parallel world: loaders of an export of the format ``worlds``, for three simulators.

    scene-envs sample prior=dimsum_table count=64 project=true export=worlds output=runs/tables
    python examples/worlds.py runs/tables/export/worlds.npz

steps 16 worlds at once with MuJoCo Warp (``pip install mujoco-warp``), each with a scene of its own, on a GPU where
there is one. ``nworld=4096`` is the number of worlds, ``steps=50`` that of steps of 2 ms. Kernels are compiled on the
first run, for about a minute. The loaders need no part of SceneEnvs: copy them to where you train.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np


def compiled(path: str | Path) -> Any:
    """The model that all worlds share."""
    return mujoco.MjModel.from_xml_path(str(Path(path).with_suffix(".xml")))


def world_fields(
    path: str | Path, model: Any, scenes: Sequence[int], prefix: str = "", at: Sequence[float] = (0.0, 0.0, 0.0)
) -> dict[str, Any]:
    """Fields (W, ...) of ``model`` in which world w holds scene ``scenes[w]``. The model is worlds.xml, or one with
    other bodies, such as a robot, to which it is attached under a ``prefix``; then the scenes' origin is ``at`` (m).
    """
    with np.load(path) as file:
        fields = {key[6:]: file[key][scenes] for key in file if key.startswith("world/")}
        fields |= {key[5:]: file[key][fields["geom_dataid"]] for key in file if key.startswith("mesh/")}
    fields["body_pos"] += at
    fields["cam_pos"] += at
    fields["qpos0"].reshape(len(scenes), -1, 7)[..., :3] += at
    names = [model.body(index).name.removeprefix(prefix) for index in range(model.nbody)]
    bodies = [index for index, name in enumerate(names) if name.startswith(("welded_", "object_"))]
    geometry, free = model.body_geomadr[bodies[0]], [index for index in bodies if model.body_jntnum[index]]
    material = model.geom_matid[geometry]
    for name, shift in (("geom_dataid", model.geom_dataid[geometry]), ("mat_texid", model.mat_texid[material, 1] - 1)):
        fields[name] += np.where(fields[name] < 0, 0, shift).astype(
            fields[name].dtype
        )  # mesh 0, texture 1 in worlds.xml
    joints = model.body_jntadr[free[:1]]
    first = {"body": bodies[0], "geom": geometry, "mat": material}
    first |= {"light": model.light(f"{prefix}lamp").id, "cam": model.camera(f"{prefix}scene").id}
    first |= {"dof": model.jnt_dofadr[joints].sum(), "qpos0": model.jnt_qposadr[joints].sum()}
    for name, rows in fields.items():
        kind = name.split("_")[0]
        rows = rows[:, 1:] if kind == "body" else rows  # not that of the world
        fields[name] = np.repeat(getattr(model, name)[None], len(scenes), axis=0)
        fields[name][:, first[kind] : first[kind] + rows.shape[1]] = rows
    return fields


def mujoco_world(path: str | Path, scene: int) -> tuple[Any, Any]:
    """Model and data of one scene in MuJoCo."""
    model = compiled(path)
    for name, rows in world_fields(path, model, [scene]).items():
        getattr(model, name)[:] = rows[0]
    absent = model.geom_dataid < 0
    model.geom_contype[absent] = model.geom_conaffinity[absent] = model.geom_rgba[absent] = 0
    model.geom_sameframe[:] = 0  # no geometry is in the frame of its body
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # the trees of boxes are of the compiled meshes
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)  # the mass matrix at the start
    model.stat.meaninertia = model.dof_M0.sum() / max(1, model.nv)  # the scale of the solver's tolerance
    mujoco.mj_resetData(model, data)
    return model, data


def fill(m: Any, fields: dict[str, Any]) -> None:
    """Give a model of MuJoCo Warp the fields of its worlds. Two at least: those of one would be taken for all."""
    import warp

    for name, rows in fields.items():
        field = getattr(m, name)
        shape = rows.shape if name != "geom_aabb" else (*rows.shape[:-1], 2, 3)
        filled = warp.array(rows.reshape(shape), dtype=field.dtype)
        if field.shape == filled.shape:
            field.assign(filled)  # a captured graph goes on reading it
        else:
            setattr(m, name, filled)


def warp_worlds(path: str | Path, nworld: int, contacts: int = 1500, most: int = 2500) -> tuple[Any, Any]:
    """Model and data of ``nworld`` worlds in MuJoCo Warp; scenes repeat where there are more worlds. There is room for
    ``contacts`` per world on average, and for ``most`` in one world; ``overflow`` of the data says where it was short.
    """
    import mujoco_warp

    model, count = compiled(path), len(np.load(path)["slots"])
    m = mujoco_warp.put_model(model)
    fill(m, world_fields(path, model, np.arange(max(2, nworld)) % count))
    d = mujoco_warp.make_data(model, nworld=nworld, nconmax=contacts, njmax=3 * most, njmax_nnz=36 * most)
    mujoco_warp.reset_data(m, d)  # all objects stand where their world says
    return m, d


def newton_worlds(path: str | Path, scenes: Sequence[int], contacts: int = 400) -> tuple[Any, Any]:
    """Model of Newton with one world per scene, and its solver; ``model.state()`` is where objects stand."""
    import newton
    import warp

    model, fields = compiled(path), world_fields(path, compiled(path), scenes)
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    meshes = {}
    for mesh, (corner, corners, face, faces) in enumerate(
        zip(model.mesh_vertadr, model.mesh_vertnum, model.mesh_faceadr, model.mesh_facenum, strict=True)
    ):
        triangles = model.mesh_face[face : face + faces].ravel()
        meshes[mesh] = newton.Mesh(model.mesh_vert[corner : corner + corners], triangles, compute_inertia=False)

    def frame(position: Any, quaternion: Any) -> Any:
        return warp.transform(position.tolist(), np.roll(quaternion, -1).tolist())

    for world in range(len(scenes)):
        f = {name: rows[world] for name, rows in fields.items()}
        builder.begin_world()
        for body in range(1, model.nbody):
            pose, target = frame(f["body_pos"][body], f["body_quat"][body]), -1
            if model.body_dofnum[body]:
                turn = np.zeros(9)
                mujoco.mju_quat2Mat(turn, f["body_iquat"][body])
                turn = turn.reshape(3, 3)
                target = builder.add_body(
                    xform=pose,
                    mass=f["body_mass"][body],
                    com=f["body_ipos"][body].tolist(),
                    inertia=warp.mat33((turn * f["body_inertia"][body]) @ turn.T),
                    lock_inertia=True,
                    custom_attributes={"mujoco:gravcomp": f["body_gravcomp"][body]},
                )
            for geom in range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body]):
                if f["geom_dataid"][geom] < 0 or not model.geom_contype[geom]:
                    continue
                place = frame(f["geom_pos"][geom], f["geom_quat"][geom])
                builder.add_shape_convex_hull(
                    target,
                    mesh=meshes[f["geom_dataid"][geom]],
                    xform=pose * place if target < 0 else place,
                    cfg=newton.ModelBuilder.ShapeConfig(density=0.0, gap=0.0, mu=f["geom_friction"][geom, 0]),
                    custom_attributes={
                        "mujoco:solref": model.geom_solref[geom].tolist(),
                        "mujoco:solref_mode": 1,  # solref as it is, not from the stiffness of the shape
                        "mujoco:geom_solimp": model.geom_solimp[geom].tolist(),
                    },
                )
        builder.end_world()
    finished, option = builder.finalize(), model.opt
    room = {"nconmax": contacts, "njmax": 4 * contacts}
    settings = {"cone": "elliptic", "impratio": option.impratio, "integrator": "implicitfast", "enable_multiccd": True}
    return finished, newton.solvers.SolverMuJoCo(finished, **room, **settings)


def main() -> None:
    """Step worlds and say how fast, and how far objects moved."""
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
    after = d.qpos.numpy()
    seconds = time.perf_counter() - start
    way = np.linalg.norm((after - before).reshape(nworld, -1, 7)[..., :3], axis=2).max(axis=1)
    print(f"{nworld} worlds, {steps} steps of 2 ms: {nworld * (steps - 1) / seconds:.0f} steps of a world a second")
    print(f"objects moved by up to {1e3 * np.median(way):.2f} mm in the median world, {1e3 * way.max():.2f} mm in all")
    kinds = mujoco_warp.OverflowType
    if (d.overflow.numpy() & (kinds.NEFC | kinds.NJMAX_NNZ | kinds.BROADPHASE | kinds.NARROWPHASE)).any():
        sys.exit("contacts were left out: give warp_worlds room for more")


if __name__ == "__main__":
    main()
