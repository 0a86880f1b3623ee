"""FCL: closed forms of contacts and gaps, and the calls that the packages do not make."""

from __future__ import annotations

import ast
from types import SimpleNamespace

import numpy as np
import pytest
from fcl import Transform
from scipy.spatial.transform import Rotation
from trimesh import creation

from scene_envs.assets.base import ConvexPart
from scene_envs.assets.fcl import YES_OR_NO, Broadphase, Shapes, convex, gap
from scene_envs.assets.shapes import box
from tests.helpers.import_graph import FILES

SIDE = 0.1


def cubes(*places: tuple[float, float, float], yaw: float = 0.0) -> list:
    """Placed cubes of 0.1 m; the last is turned."""
    shapes = Shapes([SimpleNamespace(fine=(box((SIDE, SIDE, SIDE)),))])
    turns = [0.0] * (len(places) - 1) + [yaw]
    rotations = Rotation.from_rotvec(np.outer(turns, (0, 0, 1))).as_matrix()
    return [part for (part,) in shapes.place([0] * len(places), rotations, np.array(places))]


@pytest.mark.parametrize("distance", [0.2, 0.03, 1e-3, 1e-5, -1e-5, -0.05, -SIDE])
def test_gap_and_contact_of_two_boxes(distance: float) -> None:
    """Beside each other, overlapping, and at the same place."""
    one, other = cubes((0, 0, 0), (SIDE + distance, 0, 0))
    assert gap(one, other) == pytest.approx(max(distance, 0.0), abs=1e-6)
    assert Broadphase([one]).meets(other) is (distance < 0)


def test_gap_of_an_edge() -> None:
    """A cube turned by 45 degrees reaches half its diagonal."""
    one, other = cubes((0, 0, 0), (0.15, 0, 0), yaw=np.pi / 4)
    assert gap(one, other) == pytest.approx(0.15 - SIDE / 2 - SIDE / 2**0.5, abs=1e-6)


def test_gap_of_a_ball() -> None:
    """From a corner of a polyhedron in a ball of 5 cm, along the axis through it, to a box."""
    corner = creation.icosphere(subdivisions=3, radius=0.05)
    ball = convex(ConvexPart(np.array(corner.vertices), np.array(corner.faces)))
    axis = corner.vertices[0] / 0.05
    wall = convex(box((1.0, 1.0, SIDE)))  # its base is at z = 0
    turn = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])[0].as_matrix()
    wall.setTransform(Transform(turn, 0.08 * axis))
    assert gap(ball, wall) == pytest.approx(0.03, abs=1e-6)


def test_a_tree_forgets_nothing() -> None:
    """It tries the last part met first, and its answers depend on no earlier question."""
    tree = Broadphase(cubes((0, 0, 0), (1, 0, 0), (2, 0, 0)))
    probe = convex(box((SIDE, SIDE, SIDE)))
    answers = []
    for x in (0.05, 1.05, 0.5, 0.05, 2.0, 1.5, 5.0):
        probe.setTransform(Transform(np.eye(3), np.array([x, 0.0, 0.0])))
        answers.append(tree.meets(probe))
    assert answers == [True, True, False, True, True, False, False]
    assert not Broadphase([]).meets(probe)


def test_a_scene_has_its_own_copy_of_each_part() -> None:
    shapes = Shapes([SimpleNamespace(fine=(box((SIDE, SIDE, SIDE)),))])
    turns = np.broadcast_to(np.eye(3), (2, 3, 3))
    before = shapes.place([0, 0], turns, np.array([[0, 0, 0], [1.0, 0, 0]]))
    assert gap(before[0][0], before[1][0]) == pytest.approx(1 - SIDE)
    after = shapes.place([0, 0], turns, np.array([[0, 0, 0], [0.5, 0, 0]]))
    assert gap(after[0][0], after[1][0]) == pytest.approx(0.5 - SIDE)
    assert before[1][0] is after[1][0]


ALLOWED = {
    "BVHModel",
    "CollisionObject",
    "CollisionRequest",
    "CollisionResult",
    "Convex",
    "DynamicAABBTreeCollisionManager",
    "Sphere",
    "Transform",
}
"""FCL's signed distance ends the process on some touching pairs; its contacts and its other solver are wrong there."""


def test_only_calls_that_never_end_the_process_are_made() -> None:
    """``fcl.collide`` and ``fcl.distance`` of two objects, without a request or with the default one: contact as yes or
    no, unsigned distance. Nothing else of FCL is used, under any name.
    """
    assert not YES_OR_NO.enable_contact
    assert YES_OR_NO.num_max_contacts == 1
    users = set()
    for name, file in FILES.items():
        tree = ast.parse(file.read_text(encoding="utf-8"))
        called = {node.func: node for node in ast.walk(tree) if isinstance(node, ast.Call)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                assert all(alias.asname is None for alias in node.names if alias.name == "fcl"), name
            if isinstance(node, ast.ImportFrom) and node.module == "fcl":
                users.add(name)
                assert {alias.name for alias in node.names} <= ALLOWED, name
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "fcl":
                users.add(name)
                if node.attr not in ALLOWED:
                    assert node.attr in ("collide", "distance"), (name, node.lineno)
                    arguments = called[node].args
                    default = [ast.unparse(argument) for argument in arguments[2:3]]
                    assert called[node].keywords == [], (name, node.lineno)
                    assert default == ([] if len(arguments) == 2 else ["YES_OR_NO"]), (name, node.lineno)
    assert users == {"scene_envs.assets.importing.solids", "scene_envs.assets.fcl", "scene_envs.physics.grasping"}
