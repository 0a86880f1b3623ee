"""Verdicts of feasibility of this package and of Drake, by the same definition on the same convex parts.

    python benchmarks/parity.py [TYPE ...] [--scenes 10] [--kinds raw "2 mm" "10 mm" prior] [--seed 0]
                                [--friction 0.6] [--contact hydroelastic]

``--scenes`` is the number of scenes of each type and kind. The kinds are:

- raw: scenes as generated,
- 2 mm: with Gaussian noise on every free object, 2 mm sideways and 0.4 mm in height,
- 10 mm: with noise of 10 mm sideways and 2 mm in height,
- prior: samples of the shipped prior in 50 steps.

Drake's verdict. Each fine convex part of an asset is a convex geometry, and all parts of an asset are one body.
Welded objects belong to the world. The depth of two parts is that of `QueryObject.ComputePointPairPenetration`. If
this depth is above 1 mm, the smaller of it and of `ComputeSignedDistancePairClosestPoints` is taken, because both
iterate and may stop at a direction that is not the shortest. The depth of two objects is that of their deepest two
parts. An object in a pair deeper than 1 mm is infeasible. Such objects are put out of reach, and the others move for
0.1 s under gravity in the discrete `MultibodyPlant`, with 1 ms steps, the SAP solver, Drake's default approximation
of contact ("lagged") and one friction for all. An object that is then more than 1 mm (object frame) or 0.01 rad from
its pose is infeasible. Every object is simulated, with all its parts at their true size.

Contact is hydroelastic by default and acts over a patch. Welded objects are rigid. Others are compliant with 1e8 Pa,
so objects at rest sink by micrometres. With `--contact point` each part pair has one contact point, and a box rocks
on it. Hunt-Crossley dissipation of 20 s/m lets overlaps within the limit open at 50 mm/s at most. Objects that open
faster would hop.

The table gives, for each type and kind, the number of objects, the number of verdicts that differ, those of them that
differ on penetration (deeper than 1 mm in one only) and on motion (all others), the largest difference in depth among
objects that neither finds deep, and the seconds in Drake. A line follows for each object whose verdict differs.
Scenes that one of the two could not simulate are named and left out.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache

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

from scene_envs.assets.base import Asset
from scene_envs.export import PlacedScene, place
from scene_envs.grammars import get_grammar
from scene_envs.physics import FeasibilityResult, PhysicsPool, feasibility
from scene_envs.physics.parts import FRICTION
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

Array = NDArray[np.float64]

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
    """The verdicts on the slots of one or more scenes.

    Attributes:
        feasible: (B, N) bool.
        depth: (B, N) m.
        displacement: (B, N) m, 0 where an object is deep.
        rotation: (B, N) rad, 0 where an object is deep.
        valid: (B,) bool.
    """

    feasible: NDArray[np.bool_]
    depth: Array
    displacement: Array
    rotation: Array
    valid: NDArray[np.bool_]

    @classmethod
    def of(cls, result: FeasibilityResult) -> Verdicts:
        """The verdicts of ``feasibility``."""
        depth, displacement, rotation = (
            values.double().numpy() for values in (result.depth, result.displacement, result.rotation)
        )
        return cls(result.feasible.numpy(), depth, displacement, rotation, result.valid.numpy())


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
        displacement, rotation, feasible = np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
        for slot in kept:
            end = self.plant.EvalBodyPoseInWorld(context, self.bodies[slot])
            displacement[slot] = np.linalg.norm(end.translation() - self.poses[slot].translation())
            turn = self.poses[slot].rotation().inverse() @ end.rotation()
            rotation[slot] = abs(turn.ToAngleAxis().angle())
            feasible[slot] = displacement[slot] <= MOVED and rotation[slot] <= TURNED
        return Verdicts(feasible[None], depth[None], displacement[None], rotation[None], np.array([valid]))


def drake_verdicts(batch: SceneBatch, friction: float, contact: str) -> Verdicts:
    """The verdicts of Drake on all slots."""
    rows = [DrakeScene(scene, friction, contact).verdicts() for scene in place(batch)]
    return Verdicts(
        np.concatenate([row.feasible for row in rows]) & batch.in_workspace.numpy(),
        np.concatenate([row.depth for row in rows]),
        np.concatenate([row.displacement for row in rows]),
        np.concatenate([row.rotation for row in rows]),
        np.concatenate([row.valid for row in rows]),
    )


def scenes_of(name: str, kind: str, count: int, seed: int) -> SceneBatch:
    """Scenes of a type and kind."""
    if kind == "prior":
        from agents import ScenePrior

        return ScenePrior.load(name).sample(count, num_steps=50, seed=seed)
    clean = get_grammar(name).sample(np.random.default_rng([seed, list(NOISE).index(kind)]), count)
    return disturbed(clean, *NOISE[kind], torch.Generator().manual_seed(seed))


@dataclass
class Tally:
    """Counts over objects."""

    scenes: int = 0
    objects: int = 0
    feasible: int = 0
    feasible_drake: int = 0
    penetration: int = 0
    motion: int = 0
    depth: float = 0.0
    seconds: float = 0.0

    def row(self) -> list[str]:
        """Cells of the table, without the names."""
        differ = self.penetration + self.motion
        counts = [self.scenes, self.objects, self.feasible, self.feasible_drake]
        shares = [f"{differ} ({differ / max(self.objects, 1):.2%})", str(self.penetration), str(self.motion)]
        return [*map(str, counts), *shares, f"{1e6 * self.depth:.1f}", f"{self.seconds:.0f}"]


def compare(batch: SceneBatch, ours: Verdicts, drake: Verdicts, label: str, tallies: list[Tally]) -> None:
    """Add one batch to the tallies, and print the objects whose verdicts differ."""
    judged = ours.valid & drake.valid
    for scene in np.flatnonzero(~judged).tolist():
        print(f"{label} scene {scene} left out: {'Drake' if ours.valid[scene] else 'PyBullet'} could not simulate it")
    free = batch.is_free.numpy() & judged[:, None]
    shallow = free & (np.maximum(ours.depth, drake.depth) <= DEEP)
    differ = free & (ours.feasible != drake.feasible)
    deep = free & ((ours.depth > DEEP) != (drake.depth > DEEP))
    for tally in tallies:
        tally.scenes += int(judged.sum())
        tally.objects += int(free.sum())
        tally.feasible += int(ours.feasible[free].sum())
        tally.feasible_drake += int(drake.feasible[free].sum())
        tally.penetration += int((differ & deep).sum())
        tally.motion += int((differ & ~deep).sum())
        tally.depth = max(tally.depth, float(np.abs(ours.depth - drake.depth)[shallow].max(initial=0.0)))
    for scene, slot in np.argwhere(differ).tolist():
        asset = batch.scene_type.assets[int(batch.categories[scene, slot])]
        figures = [
            f"{'yes' if one.feasible[scene, slot] else 'no'}, {1e3 * one.depth[scene, slot]:.3f} mm deep, "
            f"moves {1e3 * one.displacement[scene, slot]:.3f} mm {1e3 * one.rotation[scene, slot]:.2f} mrad"
            for one in (ours, drake)
        ]
        print(
            f"{label} scene {scene} slot {slot} {asset}: feasible here {figures[0]}; in Drake {figures[1]}", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"scene types, of {', '.join(list_scene_types())}")
    parser.add_argument("--scenes", type=int, default=10, help="scenes of each type and kind")
    parser.add_argument("--kinds", nargs="+", choices=[*NOISE, "prior"], default=list(NOISE))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--friction", type=float, default=FRICTION, help="in Drake, of all surfaces")
    parser.add_argument("--contact", choices=list(CONTACT), default="hydroelastic")
    options = parser.parse_args()
    torch.set_num_threads(1)
    columns = (
        "scenes",
        "objects",
        "feasible",
        "in Drake",
        "differ",
        "penetration",
        "motion",
        "depth (µm)",
        "CPU s",
    )
    title = f"verdicts, friction {options.friction:g} and {options.contact} contact in Drake"
    table, total = Table("scene type", "kind", *columns, title=title), Tally()
    with PhysicsPool(workers=1) as pool:
        for name in options.types or list_scene_types():
            for kind in options.kinds:
                batch, tally = scenes_of(name, kind, options.scenes, options.seed), Tally()
                ours = Verdicts.of(feasibility(batch, pool=pool))
                start = time.process_time()
                drake = drake_verdicts(batch, options.friction, options.contact)
                tally.seconds = time.process_time() - start
                total.seconds += tally.seconds
                compare(batch, ours, drake, f"{name}, {kind},", [tally, total])
                table.add_row(name, kind, *tally.row())
    table.add_section()
    table.add_row("all", "", *total.row())
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
