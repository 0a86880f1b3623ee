"""Agreement of physics engines: verdicts of feasibility by one definition on the same convex parts.

    python benchmarks/engines.py [TYPE ...] [--engines bullet mujoco drake "MuJoCo C"] [--scenes 10] [--seed 0]
                                 [--kinds raw "2 mm" "10 mm" prior] [--samples FOLDER] [--list]

``--scenes`` is the number of scenes of each type and kind. The kinds are:

- raw: scenes as generated,
- 2 mm: with Gaussian noise on every free object, 2 mm sideways and 0.4 mm in height,
- 10 mm: with noise of 10 mm sideways and 2 mm in height,
- prior: samples of the shipped prior in 50 steps; ``--samples`` is a folder in which they are kept between runs.

The engines are those of this package (``bullet``, ``mujoco``), by ``feasibility(batch, physics=NAME)``, and whole
simulations in which every object moves with all its parts:

- MuJoCo C: the exported MJCF file with its settings. The depth of two parts is that of MuJoCo's contact, found with
  one contact per pair (``multiccd`` off) and up to 200 iterations.
- drake: the depth of two parts is that of `QueryObject.ComputePointPairPenetration`. If this depth is above 1 mm, the
  smaller of it and of `ComputeSignedDistancePairClosestPoints` is taken, because both iterate and may stop at a
  direction that is not the shortest. Motion is that of the discrete `MultibodyPlant`, with 1 ms steps, the SAP solver,
  Drake's default approximation of contact ("lagged") and one friction for all. Contact is hydroelastic by default and
  acts over a patch. Welded objects are rigid. Others are compliant with 1e8 Pa, so objects at rest sink by
  micrometres. With `--contact point` each part pair has one contact point, and a box rocks on it. Hunt-Crossley
  dissipation of 20 s/m lets overlaps within the limit open at 50 mm/s at most. Objects that open faster would hop.

The depth of two objects is that of their deepest two parts. An object in a pair deeper than 1 mm is infeasible. Such
objects are removed, and the others move for 0.1 s under gravity. An object that is then more than 1 mm (object frame)
or 0.01 rad from its pose is infeasible.

The table gives, for each pair of engines and kind of scene, the verdicts that differ: on penetration (deeper than 1 mm
in one only), and on motion, among objects of scenes in which both removed the same objects. It gives also the largest
difference in depth among objects that neither finds deep. Scenes that one of the two could not judge are left out and
counted. ``--list`` prints each object whose verdict differs. A second table gives the CPU seconds of each engine.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
import torch
from feasibility import disturbed
from numpy.typing import NDArray
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Convex,
    GeometryId,
    ProximityProperties,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    ContactModel,
    CoulombFriction,
    DiscreteContactApproximation,
    MultibodyPlant,
)
from pydrake.multibody.tree import RigidBody, RotationalInertia, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from scene_envs.assets.base import Asset
from scene_envs.export import PlacedScene, export, place
from scene_envs.grammars import get_grammar
from scene_envs.physics import feasibility
from scene_envs.physics.parts import FRICTION
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NOISE = {"raw": (0.0, 0.0), "2 mm": (0.002, 0.0004), "10 mm": (0.010, 0.002)}
"""Standard deviations (m) sideways and in height."""
CONTACT = {"hydroelastic": ContactModel.kHydroelasticWithFallback, "point": ContactModel.kPoint}
DEEP, MOVED, TURNED, DURATION = 1e-3, 1e-3, 1e-2, 0.1
"""Limits of the definition: depth (m), displacement (m) and rotation (rad), and the duration (s)."""
_STEP = 1e-3
_MODULUS, _STIFFNESS = 1e8, 1e8
"""Of patches (Pa) and of points (N/m); the solver limits both to what its step can resolve."""
_DISSIPATION = 20.0
"""s/m; its inverse is the greatest speed at which an overlap opens."""
_AWAY = 100.0
"""Distance (m) between objects that are put out of reach."""


@dataclass(frozen=True)
class Verdicts:
    """What an engine finds in the slots of one or more scenes.

    Attributes:
        depth: (B, N) m.
        displacement: (B, N) m, 0 where an object is deep.
        rotation: (B, N) rad, 0 where an object is deep.
        valid: (B,) bool.
    """

    depth: Array
    displacement: Array
    rotation: Array
    valid: Mask

    @property
    def deep(self) -> Mask:
        """(B, N) whether an object is in a pair that overlaps too deeply."""
        return self.depth > DEEP

    @property
    def moved(self) -> Mask:
        """(B, N) whether an object moves or turns too far."""
        return (self.displacement > MOVED) | (self.rotation > TURNED)

    @classmethod
    def concatenate(cls, rows: list[Verdicts]) -> Verdicts:
        """The verdicts of several scenes with the same number of slots."""
        return cls(*(np.concatenate([getattr(row, name) for row in rows]) for name in cls.__annotations__))


Engine = Callable[[SceneBatch], Verdicts]
"""Verdicts on all slots of some scenes of one type."""


def product_verdicts(batch: SceneBatch, physics: str) -> Verdicts:
    """The verdicts of an engine of this package."""
    result = feasibility(batch, physics=physics)
    found = (getattr(result, name).double().numpy() for name in ("depth", "displacement", "rotation"))
    return Verdicts(*found, valid=result.valid.numpy())


def exported_verdicts(batch: SceneBatch, friction: float) -> Verdicts:
    """The verdicts of MuJoCo C on the exported files."""
    with tempfile.TemporaryDirectory() as folder:
        export(batch, folder, "mjcf", friction=friction)
        return Verdicts.concatenate([
            _exported_scene(mujoco.MjModel.from_xml_path(f"{folder}/scene_{scene.index:03d}/scene.xml"), scene)
            for scene in place(batch)
        ])  # fmt: skip


def _exported_scene(model: mujoco.MjModel, scene: PlacedScene) -> Verdicts:
    data = mujoco.MjData(model)
    slot_of = {model.body(thing.name).id: thing.slot for thing in scene.objects}
    depth, displacement, rotation = np.zeros((3, 1, scene.slots))
    flags, iterations = model.opt.disableflags, model.opt.ccd_iterations
    model.opt.disableflags, model.opt.ccd_iterations = flags | mujoco.mjtDisableBit.mjDSBL_MULTICCD, 200
    mujoco.mj_forward(model, data)
    for contact in data.contact:
        for body in model.geom_bodyid[contact.geom]:
            depth[0, slot_of[body]] = max(depth[0, slot_of[body]], -contact.dist)
    model.opt.disableflags, model.opt.ccd_iterations = flags, iterations
    free = [thing for thing in scene.objects if not thing.welded]
    for thing in free:
        if depth[0, thing.slot] > DEEP:  # falls through everything
            parts = model.geom_bodyid == model.body(thing.name).id
            model.geom_contype[parts] = model.geom_conaffinity[parts] = 0
    mujoco.mj_step(model, data, round(DURATION / model.opt.timestep))
    mujoco.mj_kinematics(model, data)
    for thing in free:
        if depth[0, thing.slot] <= DEEP:
            body = data.body(thing.name)
            displacement[0, thing.slot] = np.linalg.norm(body.xpos - thing.translation)
            turn = Rotation.from_matrix(body.xmat.reshape(3, 3)) * Rotation.from_matrix(thing.rotation).inv()
            rotation[0, thing.slot] = turn.magnitude()
    is_lost = any(warning.number for warning in data.warning)
    return Verdicts(depth, displacement, rotation, np.array([not is_lost]))


@cache
def shapes(asset: Asset) -> tuple[Convex, ...]:
    """The fine parts of an asset."""
    return tuple(Convex(part.vertices.T, f"{asset.name} {i}") for i, part in enumerate(asset.fine))


def surface(welded: bool, friction: float, contact: str) -> ProximityProperties:
    """Contact properties of an object."""
    properties = ProximityProperties()
    surface_friction = CoulombFriction(friction, friction)
    AddContactMaterial(_DISSIPATION, _STIFFNESS, surface_friction, properties)
    if contact == "hydroelastic" and welded:
        AddRigidHydroelasticProperties(properties)
    elif contact == "hydroelastic":
        AddCompliantHydroelasticProperties(1.0, _MODULUS, properties)
    return properties


class DrakeScene:
    """One scene in Drake.

    Args:
        scene: the scene.
        friction: of all surfaces.
        contact: a name of ``CONTACT``.
    """

    def __init__(self, scene: PlacedScene, friction: float, contact: str) -> None:
        builder = DiagramBuilder()
        plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=_STEP)
        self.plant: MultibodyPlant = plant
        self.plant.set_contact_model(CONTACT[contact])
        self.plant.set_discrete_contact_approximation(DiscreteContactApproximation.kLagged)
        self.scene = scene
        self.bodies: dict[int, RigidBody] = {}
        self.poses: dict[int, RigidTransform] = {}
        self.slot_of: dict[GeometryId, int] = {}
        for thing in scene.objects:
            pose = RigidTransform(RotationMatrix(thing.rotation), thing.translation)
            asset, body, place_of = thing.asset, self.plant.world_body(), pose
            if not thing.welded:
                inertia = asset.inertia
                central = RotationalInertia(
                    inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]
                )
                whole = SpatialInertia.MakeFromCentralInertia(asset.mass, asset.center_of_mass, central)
                body, place_of = self.plant.AddRigidBody(thing.name, whole), RigidTransform()
                self.bodies[thing.slot], self.poses[thing.slot] = body, pose
            for index, shape in enumerate(shapes(asset)):
                properties = surface(thing.welded, friction, contact)
                name = f"{thing.name}_{index}"
                geometry = self.plant.RegisterCollisionGeometry(body, place_of, shape, name, properties)
                self.slot_of[geometry] = thing.slot
        self.plant.Finalize()
        self.diagram: Diagram = builder.Build()

    def verdicts(self) -> Verdicts:
        """The verdict on each slot, as a batch of one scene."""
        count, valid = self.scene.slots, True
        simulator = Simulator(self.diagram)
        context = self.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        for slot, body in self.bodies.items():
            self.plant.SetFreeBodyPose(context, body, self.poses[slot])
        depth = np.zeros(count)
        query = self.plant.get_geometry_query_input_port().Eval(context)
        for pair in query.ComputePointPairPenetration():
            way_out = pair.depth
            if way_out > DEEP:
                way_out = min(way_out, -query.ComputeSignedDistancePairClosestPoints(pair.id_A, pair.id_B).distance)
            for slot in (self.slot_of[pair.id_A], self.slot_of[pair.id_B]):
                depth[slot] = max(depth[slot], way_out)
        kept = [slot for slot in self.bodies if depth[slot] <= DEEP]
        for slot in self.bodies.keys() - kept:
            away = RigidTransform(np.array([_AWAY * (2 + slot), 0.0, 0.0]))
            self.plant.SetFreeBodyPose(context, self.bodies[slot], away)
        try:
            simulator.AdvanceTo(DURATION)
        except RuntimeError as error:  # the solver did not converge
            print(f"scene {self.scene.index}: {error}")
            valid = False
        displacement, rotation = np.zeros(count), np.zeros(count)
        for slot in kept:
            end = self.plant.EvalBodyPoseInWorld(context, self.bodies[slot])
            displacement[slot] = np.linalg.norm(end.translation() - self.poses[slot].translation())
            turn = self.poses[slot].rotation().inverse() @ end.rotation()
            rotation[slot] = abs(turn.ToAngleAxis().angle())
        return Verdicts(depth[None], displacement[None], rotation[None], np.array([valid]))


def drake_verdicts(batch: SceneBatch, friction: float, contact: str) -> Verdicts:
    """The verdicts of Drake on all slots."""
    return Verdicts.concatenate([DrakeScene(scene, friction, contact).verdicts() for scene in place(batch)])


def engines(friction: float, contact: str) -> dict[str, Engine]:
    """All engines by name. Add an entry to compare another one."""
    return {
        "bullet": partial(product_verdicts, physics="bullet"),
        "mujoco": partial(product_verdicts, physics="mujoco"),
        "MuJoCo C": partial(exported_verdicts, friction=friction),
        "drake": partial(drake_verdicts, friction=friction, contact=contact),
    }


def scenes_of(name: str, kind: str, count: int, seed: int, samples: Path | None) -> SceneBatch:
    """Scenes of a type and kind."""
    if kind == "prior":
        from agents import ScenePrior

        kept = None if samples is None else samples / f"{name}_{count}_{seed}.safetensors"
        if kept and kept.exists():
            return SceneBatch.load(kept)
        batch = ScenePrior.load(name).sample(count, num_steps=50, seed=seed)
        if kept:
            batch.save(kept)
        return batch
    clean = get_grammar(name).sample(np.random.default_rng([seed, list(NOISE).index(kind)]), count)
    return disturbed(clean, *NOISE[kind], torch.Generator().manual_seed(seed))


@dataclass
class Tally:
    """Counts over objects for two engines."""

    scenes: int = 0
    left_out: int = 0
    objects: int = 0
    penetration: int = 0
    compared: int = 0  # objects whose motion is compared
    motion: int = 0
    depth: float = 0.0

    def add(self, batch: SceneBatch, one: Verdicts, other: Verdicts) -> Mask:
        """Add one batch; (B, N) the objects whose verdict differs."""
        judged = one.valid & other.valid
        free = batch.is_free.numpy() & judged[:, None]
        deep = free & (one.deep != other.deep)
        alike = free & ~one.deep & ~deep.any(axis=1, keepdims=True)
        moved = alike & (one.moved != other.moved)
        shallow = free & ~one.deep & ~other.deep
        self.scenes += int(judged.sum())
        self.left_out += int((~judged).sum())
        self.objects += int(free.sum())
        self.penetration += int(deep.sum())
        self.compared += int(alike.sum())
        self.motion += int(moved.sum())
        self.depth = max(self.depth, float(np.abs(one.depth - other.depth)[shallow].max(initial=0.0)))
        return deep | moved

    def row(self) -> list[str]:
        """Cells of the table, without the names."""
        motion = f"{self.motion} of {self.compared}"
        return [
            str(self.scenes),
            str(self.left_out),
            str(self.objects),
            str(self.penetration),
            motion,
            f"{1e6 * self.depth:.1f}",
        ]


def describe(batch: SceneBatch, found: dict[str, Verdicts], scene: int, slot: int) -> str:
    """What some engines find about one object."""
    asset = batch.scene_type.assets[int(batch.categories[scene, slot])]
    figures = [
        f"{name} {1e3 * one.depth[scene, slot]:.3f} mm deep, moves {1e3 * one.displacement[scene, slot]:.3f} mm "
        f"{1e3 * one.rotation[scene, slot]:.2f} mrad"
        for name, one in found.items()
    ]
    return f"{batch.scene_type.name}, scene {scene} slot {slot} {asset}: {'; '.join(figures)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = list(engines(FRICTION, "hydroelastic"))
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"scene types, of {', '.join(list_scene_types())}")
    parser.add_argument("--engines", nargs="+", choices=names, default=names)
    parser.add_argument("--scenes", type=int, default=10, help="scenes of each type and kind")
    parser.add_argument("--kinds", nargs="+", choices=[*NOISE, "prior"], default=list(NOISE))
    parser.add_argument("--samples", type=Path, help="folder in which samples of priors are kept")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--friction", type=float, default=FRICTION, help="of all surfaces, in MuJoCo C and Drake")
    parser.add_argument("--contact", choices=list(CONTACT), default="hydroelastic", help="in Drake")
    parser.add_argument("--list", action="store_true", help="print each object whose verdict differs")
    options = parser.parse_args()
    torch.set_num_threads(1)
    known = engines(options.friction, options.contact)
    tallies: dict[tuple[str, str, str], Tally] = defaultdict(Tally)
    seconds: dict[str, float] = dict.fromkeys(options.engines, 0.0)
    scenes = 0
    for scene_type in options.types or list_scene_types():
        for kind in options.kinds:
            batch = scenes_of(scene_type, kind, options.scenes, options.seed, options.samples)
            scenes += len(batch)
            found = {}
            for name in options.engines:
                known[name](batch[:1])  # builds what is needed
                start = time.process_time()
                found[name] = known[name](batch)
                seconds[name] += time.process_time() - start
            for one, other in combinations(options.engines, 2):
                for group in (kind, "all"):
                    differ = tallies[one, other, group].add(batch, found[one], found[other])
                if options.list:
                    for scene, slot in np.argwhere(differ).tolist():
                        print(
                            kind, describe(batch, {name: found[name] for name in (one, other)}, scene, slot), flush=True
                        )
    columns = ("engines", "kind", "scenes", "left out", "objects", "penetration", "motion", "depth, µm")
    table = Table(
        *columns, title=f"verdicts that differ, friction {options.friction:g}, {options.contact} contact in Drake"
    )
    for one, other in combinations(options.engines, 2):
        for kind in [*options.kinds, "all"]:
            table.add_row(f"{one}, {other}", kind, *tallies[one, other, kind].row())
        table.add_section()
    console = Console(width=150)
    console.print(table)
    table = Table("engine", "CPU s", "scenes/s", title=f"{scenes} scenes")
    for name, spent in seconds.items():
        table.add_row(name, f"{spent:.0f}", f"{scenes / spent:.1f}")
    console.print(table)


if __name__ == "__main__":
    main()
