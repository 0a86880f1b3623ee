"""Contents of a model file in any format: shapes, inertials, and whether it is fixed to the world."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array

Color = tuple[int, int, int]
Kind = Literal["mesh", "box", "cylinder", "sphere", "capsule", "ellipsoid"]


@dataclass(frozen=True, eq=False)
class Shape:
    """One piece of geometry of a model.

    The ``size`` (m) is (x, y, z) of a box, (radius, length along z without the caps) of a cylinder or capsule,
    (radius,) of a sphere, (x, y, z radii) of an ellipsoid; of a mesh, it is the scale (x, y, z).
    """

    kind: Kind
    size: tuple[float, ...]
    pose: Array  # (4, 4) transform from the shape frame to the model frame
    where: str  # link and element, for messages
    path: Path | None = None  # file of a mesh
    color: Color | None = None  # colour (r, g, b) given by the model, or None
    is_convex: bool = False  # whether the model declares the mesh convex


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass (kg), centre of mass (3,) m and inertia (3, 3) kg m^2 about that centre, model axes."""

    mass: float
    center_of_mass: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class Model:
    """A model file at zero joint positions, in one frame."""

    visuals: tuple[Shape, ...]  # shapes to draw
    collisions: tuple[Shape, ...]  # shapes for collisions
    inertials: tuple[Inertial, ...] = ()  # inertials of the links that have one
    static: bool | None = None  # whether the model is fixed to the world; None when the file does not say
    notes: tuple[str, ...] = field(default=())  # choices of the reader that the file may not intend


def pose_of(translation: Array, rotation: Array) -> Array:
    """(4, 4) from a translation (3,) m and a rotation (3, 3)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def from_roll_pitch_yaw(angles: Array) -> Array:
    """(3, 3) rotation of URDF and SDF: about the fixed axes x, then y, then z; (3,) rad."""
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix())


def moved_inertial(pose: Array, inertial: Inertial) -> Inertial:
    """The inertial of a link in the frame that ``pose`` (4, 4) maps to."""
    turn = pose[:3, :3]
    return Inertial(
        inertial.mass, turn @ inertial.center_of_mass + pose[:3, 3], turn @ inertial.inertia @ turn.T
    )  # fmt: skip


def merged_inertial(inertials: tuple[Inertial, ...]) -> Inertial:
    """The inertial of several bodies joined to one: masses add, inertias by the parallel-axis theorem."""
    mass = sum(inertial.mass for inertial in inertials)
    weights = [inertial.mass / mass if mass > 0 else 1.0 / len(inertials) for inertial in inertials]
    center = sum((w * i.center_of_mass for w, i in zip(weights, inertials, strict=True)), np.zeros(3))
    total = np.zeros((3, 3))
    for inertial in inertials:
        arm = inertial.center_of_mass - center
        total += inertial.inertia + inertial.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass, center, total)
