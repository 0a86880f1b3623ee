"""Verdicts of engines and simulators on exported scenes, which each of them reads from the exported files."""

from __future__ import annotations

import copy
import importlib.metadata
import json
import logging
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scene_envs.errors import InvalidInputError
from scene_envs.export.api import MANIFEST, read_manifest, scene_folders
from scene_envs.export.randomization import PHYSICS
from scene_envs.files import write_json, write_text
from scene_envs.physics.parts import FRICTION, GRAVITY, angle_between

LIMITS = {"overlap, mm": 1.0, "motion in 0.1 s, mm": 1.0, "rotation in 0.1 s, mrad": 10.0, "motion in 2 s, mm": 1.0}
"""The figures that a judge finds for each object, and what they are at most for an object that is ready."""
_EARLY, _LATE = 0.1, 2.0
Objects = dict[str, Sequence[float]]
"""The figures of ``LIMITS`` for each object of a scene."""


class Finding(NamedTuple):
    """What one judge finds in one scene."""

    scene: str
    judge: str
    largest: dict[str, float]  # figures of LIMITS
    seconds: float
    faults: list[str]  # a line for each object beyond a limit, or for a file that could not be simulated


@dataclass(frozen=True)
class Verification:
    """Verdicts of all judges on the scenes of an export."""

    scenes: tuple[str, ...]
    findings: tuple[Finding, ...]
    versions: dict[str, str]  # version of the simulator of each judge
    missing: dict[str, str]  # judges that did not take part, with the line that installs them or another reason

    @property
    def ready(self) -> tuple[bool, ...]:
        """For each scene, whether all judges find it ready."""
        faulty = {found.scene for found in self.findings if found.faults}
        return tuple(name not in faulty for name in self.scenes)

    def __str__(self) -> str:
        titles = ("overlap, mm", "0.1 s: mm", "mrad", "2 s: mm", "seconds")
        lines = ["".join([f"{'judge':18}{'version':10}{'ready':10}", *(f"{title:>13}" for title in titles)])]
        for judge, version in self.versions.items():
            found = [finding for finding in self.findings if finding.judge == judge]
            ready = f"{sum(not finding.faults for finding in found)} of {len(found)}"
            figures = [*np.max([[*f.largest.values()] for f in found], axis=0), sum(f.seconds for f in found)]
            lines.append("".join([f"{judge:18}{version:10}{ready:10}", *(f"{figure:13.3f}" for figure in figures)]))
        lines += [f"not asked: {judge}, {reason}" for judge, reason in self.missing.items()]
        lines += [f"{found.scene}, {found.judge}: {fault}" for found in self.findings for fault in found.faults]
        return "\n".join([*lines, f"{sum(self.ready)} of {len(self.scenes)} scenes are ready for all judges"])


def verify(path: str | os.PathLike[str]) -> Verification:
    """Judge an export in every engine and simulator that is installed, and write ``verify.json`` and ``verify.txt``.

    A scene is ready for a judge when no figure of an object is beyond ``LIMITS``; nothing is removed. Friction, masses
    and contact settings are those of the files; only the engines of :mod:`scene_envs.physics` have their own.
    ``path`` is the folder of an export, or of a run that holds one in ``export/``.

    Raises InvalidInputError for a folder without scenes or without a file that has a judge here, and CorruptFileError.
    """
    root = next((p for p in (Path(path), Path(path, "export")) if (p / MANIFEST).is_file()), None)
    if root is None:
        raise InvalidInputError(f"{str(path)!r} holds no {MANIFEST}; name the folder of an export, as runs/mine")
    manifest = read_manifest(root / MANIFEST)
    scenes = scene_folders(manifest["scenes"])
    findings: list[Finding] = []
    versions: dict[str, str] = {}
    missing: dict[str, str] = {}
    for judge, (file, module, package, judged) in JUDGES.items():
        paths = [root / file.format(scene) for scene in scenes]
        if find_spec(module) is None:
            missing[judge] = f"not installed: pip install {package}"
        elif not all(path.is_file() for path in paths):
            missing[judge] = f"no {file.format(scenes[0] if scenes else 'scene').rpartition('/')[2]} in the export"
        elif file == _POSES and (manifest["friction"] != FRICTION or PHYSICS & {*manifest.get("randomization", ())}):
            missing[judge] = "has other friction or masses than the files"
        else:
            found = importlib.metadata.distributions(name=package.strip('"').partition("[")[0])
            versions[judge] = next((one.version for one in found), "unknown")  # as of Drake from apt
            findings += [_find(scene, judge, judged, path) for scene, path in zip(scenes, paths, strict=True)]
    if not findings:
        raise InvalidInputError(f"{str(root)!r} has no scene, or no file that can be judged here: {missing}")
    report = Verification(scenes, tuple(findings), versions, missing)
    verdict = {"digest": manifest["digest"], "ready": all(report.ready), "ready_scenes": report.ready, "limits": LIMITS}
    write_json(root / "verify.json", verdict | vars(report) | {"findings": [found._asdict() for found in findings]})
    write_text(root / "verify.txt", f"{report}\n")
    return report


def _find(scene: str, judge: str, judged: Callable[[Path], Objects], path: Path) -> Finding:
    started, faults = time.perf_counter(), []
    objects: Objects = {}
    try:
        objects = judged(path)
    except Exception as error:  # the simulator does not take the file, or gives up
        faults.append(" ".join(f"not simulated, {type(error).__name__}: {error}".split())[:400])
    for name, figures in objects.items():
        over = [f"{key} {x:.2f}" for (key, most), x in zip(LIMITS.items(), figures, strict=True) if not x <= most]
        faults += [f"{name}: {', '.join(over)}"] if over else []
    largest = np.max([*objects.values(), [0.0] * len(LIMITS)], axis=0).tolist()
    return Finding(scene, judge, dict(zip(LIMITS, largest, strict=True)), time.perf_counter() - started, faults)


def _objects(names: Sequence[str], pairs: Sequence[tuple[str, float]], after: Callable[[float], ArrayLike]) -> Objects:
    """The figures, from overlaps (m) and from poses (n, 7) after a further time (s): translation (m), quaternion."""
    start, early, late = (np.array(after(x), dtype=float).reshape(-1, 7) for x in (0.0, _EARLY, _LATE - _EARLY))
    moved, drifted = (np.linalg.norm(rows[:, :3] - start[:, :3], axis=1) for rows in (early, late))
    overlap = [max((depth for other, depth in pairs if other == name and depth > 0), default=0.0) for name in names]
    figures = np.stack([overlap, moved, angle_between(early[:, 3:], start[:, 3:]), drifted], axis=1)
    return dict(zip(names, (1e3 * figures).tolist(), strict=True))


def _engine(physics: str, path: Path) -> Objects:
    import torch

    from scene_envs.physics import equilibrium, penetration
    from scene_envs.scene import SceneBatch

    found = np.load(path)
    parts = [torch.from_numpy(found[key])[None] for key in ("translations", "rotations", "categories")]
    batch = SceneBatch.from_parts(parts[0].float(), parts[1].float(), parts[2], str(found["scene_type"]))
    overlap = penetration(batch, physics=physics)
    early, late = (equilibrium(batch, duration=seconds, physics=physics) for seconds in (_EARLY, _LATE))
    if not (overlap.valid & early.valid & late.valid).all():
        raise InvalidInputError("objects overlap too deeply")
    figures = torch.cat([overlap.depth, early.displacement, early.rotation, late.displacement]).T
    return dict(zip(found["names"].tolist(), (1e3 * figures).tolist(), strict=True))


def _mujoco(path: Path) -> Objects:
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    return _simulated(model, [model.body(index).name for index in range(1, model.nbody)])


def _newton(path: Path) -> Objects:
    """Newton's reading of a file, by its MuJoCo solver."""
    import newton
    import warp

    warp.config.quiet = True
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    (builder.add_usd if path.suffix == ".usda" else builder.add_mjcf)(str(path))
    solver = newton.solvers.SolverMuJoCo(builder.finalize(device="cpu"), use_mujoco_cpu=True)
    bodies = solver.mjc_body_to_newton.numpy()[0, 1:]
    return _simulated(solver.mj_model, [builder.body_label[body].rpartition("/")[2] for body in bodies])


def _simulated(model: Any, names: Sequence[str]) -> Objects:
    """A simulation by MuJoCo, of bodies with these names behind the world's."""
    import mujoco

    single = copy.copy(model)
    single.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD  # the distance of a single contact is a depth
    single.opt.ccd_iterations = 200
    data = mujoco.MjData(single)
    mujoco.mj_forward(single, data)
    named = ["", *names]
    pairs = [(named[body], -contact.dist) for contact in data.contact for body in single.geom_bodyid[contact.geom]]
    data = mujoco.MjData(model)

    def after(seconds: float) -> ArrayLike:
        mujoco.mj_step(model, data, round(seconds / model.opt.timestep))
        mujoco.mj_kinematics(model, data)
        return np.hstack([data.xpos[1:], data.xquat[1:]])

    return _objects(names, pairs, after)


def _pybullet(path: Path) -> Objects:
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

    client, pairs = BulletClient(pybullet.DIRECT), []
    links: dict[str, tuple[int, int]] = {}  # a body and its joint that moves it, -1 for none
    client.setGravity(0.0, 0.0, -GRAVITY)
    for item in json.loads(path.read_text())["objects"]:
        file, turn = str(path.parent / item["bullet_urdf"]), np.roll(item["quaternion_wxyz"], -1).tolist()
        keys = {"useFixedBase": item["welded"], "flags": pybullet.URDF_USE_INERTIA_FROM_FILE}
        body = client.loadURDF(file, item["translation"], turn, **keys)
        links[item["name"]] = body, -1
        for joint in range(client.getNumJoints(body)):  # what holds it is the friction of the file, and no motor
            found = client.getJointInfo(body, joint)
            client.setJointMotorControl2(body, joint, pybullet.VELOCITY_CONTROL, force=found[7])
            links[f"{item['name']}/{found[12].decode()}"] = body, joint
    client.performCollisionDetection()
    for name, (body, link) in links.items():
        pairs += [(name, -contact[8]) for contact in client.getContactPoints(bodyA=body, linkIndexA=link)]

    def after(seconds: float) -> ArrayLike:
        for _ in range(round(240 * seconds)):
            client.stepSimulation()
        return [np.concatenate(pose(*link)) for link in links.values()]

    def pose(body: int, joint: int) -> Any:
        if joint >= 0:
            return client.getLinkState(body, joint, computeForwardKinematics=True)[4:6]
        back = client.invertTransform(*client.getDynamicsInfo(body, -1)[3:5])  # it moves the frame of inertia
        return client.multiplyTransforms(*client.getBasePositionAndOrientation(body), *back)

    return _objects(list(links), pairs, after)


def _drake(path: Path) -> Objects:
    import pydrake.all as drake

    logging.getLogger("drake").setLevel(logging.ERROR)  # a line for each part of an SDF
    builder = drake.DiagramBuilder()
    plant, _ = drake.AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    parser = drake.Parser(plant)
    if path.suffix == ".yaml":
        parser.package_map().AddPackageXml(path.parents[1] / "package.xml")
    models = parser.AddModels(path)
    plant.Finalize()
    diagram = builder.Build()
    simulator = drake.Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    bodies: dict[str, Any] = {}
    for model in models:
        first, *links = map(plant.get_body, plant.GetBodyIndices(model))
        name = plant.GetModelInstanceName(model)
        bodies |= {name: first} | {f"{name}/{link.name()}": link for link in links}
    owner = {g: name for name, body in bodies.items() for g in plant.GetCollisionGeometriesForBody(body)}
    query = plant.get_geometry_query_input_port().Eval(context)
    found = query.ComputePointPairPenetration()
    pairs = [(owner[part], pair.depth) for pair in found for part in (pair.id_A, pair.id_B)]

    def after(seconds: float) -> ArrayLike:
        simulator.AdvanceTo(context.get_time() + seconds)
        found = [plant.EvalBodyPoseInWorld(context, body) for body in bodies.values()]
        return [[*pose.translation(), *pose.rotation().ToQuaternion().wxyz()] for pose in found]

    return _objects(list(bodies), pairs, after)


_POSES, _NEWTON = "{}/scene.npz", '"newton[sim,importers]"'
JUDGES: dict[str, tuple[str, str, str, Callable[[Path], Objects]]] = {
    "bullet engine": (_POSES, "pybullet", "pybullet", partial(_engine, "bullet")),
    "mujoco engine": (_POSES, "mujoco", "mujoco", partial(_engine, "mujoco")),
    "MuJoCo, MJCF": ("{}/scene.xml", "mujoco", "mujoco", _mujoco),
    "Newton, MJCF": ("{}/scene.xml", "newton", _NEWTON, _newton),
    "Newton, USD": ("{}.usda", "newton", _NEWTON, _newton),
    "PyBullet, URDF": ("{}/objects.json", "pybullet", "pybullet", _pybullet),
    "Drake, directives": ("{}/scene.dmd.yaml", "pydrake", "drake", _drake),
    "Drake, SDF": ("{}/world.sdf", "pydrake", "drake", _drake),
}
"""Of each judge: the file that it reads, ``{}`` for the scene's name, module and package that it needs, function."""
