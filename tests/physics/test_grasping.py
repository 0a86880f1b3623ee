"""Approaches of a gripper: hand-made scenes, and collisions against FCL."""

from __future__ import annotations

import fcl
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics.grasping import Gripper, _hand, reachable
from scene_envs.physics.placement import Budget, flatten
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, scene

UP, FRONT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
WIDE = Gripper(opening=SIDE + 0.02)


def reached(batch: SceneBatch, approach: tuple[float, float, float], gripper: Gripper = WIDE) -> list[bool]:
    """Verdicts on the free objects of one scene."""
    return reachable(batch, [approach], gripper).reached[0, 0][batch.is_free[0]].tolist()


def test_a_box_is_grasped_when_it_fits_between_the_fingers() -> None:
    alone = scene(("cube", 0.0, 0.0, 0.0), yaw=0.4)
    assert reached(alone, UP) == [True]
    assert reached(alone, UP, Gripper(opening=SIDE - 0.01)) == [False]
    assert reached(alone, UP, Gripper(opening=SIDE + 1e-3)) == [True]
    assert not bool(reachable(alone, [UP]).reached[0, 0, 0])  # the floor is welded


def test_neighbours_bar_the_fingers_only_where_there_is_no_room() -> None:
    """Between two neighbours 5 mm away fingers of 8 mm fit along the open sides only; between four they do not."""
    gap = SIDE + 0.005
    two = [("cube", gap, 0.0, 0.0), ("cube", -gap, 0.0, 0.0)]
    four = [*two, ("cube", 0.0, gap, 0.0), ("cube", 0.0, -gap, 0.0)]
    assert reached(scene(("cube", 0.0, 0.0, 0.0), *two), UP)[0]
    assert not reached(scene(("cube", 0.0, 0.0, 0.0), *four), UP)[0]
    assert reached(scene(("cube", 0.0, 0.0, 0.0), *four), FRONT)[1:] == [True, False, False, False]
    apart = [(name, 1.2 * x, 1.2 * y, z) for name, x, y, z in four]
    assert reached(scene(("cube", 0.0, 0.0, 0.0), *apart), UP)[0]


def test_what_is_in_the_way_bars_it_from_that_side() -> None:
    """A box on top bars the way from above, and the lower half of it from the front stays free."""
    stack = scene(("cube", 0.0, 0.0, 0.0), ("cube", 0.0, 0.0, SIDE))
    assert reached(stack, UP) == [False, True]
    behind = scene(("post", 0.0, 0.0, 0.0), ("cube", 0.1, 0.0, 0.0), ("cube", 0.1, 0.0, SIDE))
    assert reached(behind, UP)[0]
    assert not reached(behind, FRONT)[0]


def test_rims_are_grasped_and_flat_things_down_to_the_floor() -> None:
    assert reached(scene(("bowl", 0.0, 0.0, 0.0)), UP, Gripper(opening=0.05)) == [True]
    lying = Rotation.from_euler("y", np.pi / 2).as_matrix()
    post = scene(("post", 0.0, 0.0, 0.01))
    rotations = post.rotations.clone()
    rotations[0, 1] = torch.from_numpy(lying).float()
    assert reached(post.with_poses(post.translations, rotations), UP, Gripper()) == [True]


@pytest.mark.slow
def test_verdicts_depend_neither_on_the_batch_nor_on_the_heading() -> None:
    batch = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 2)
    batch = SceneBatch(batch.tensor[:, :24], batch.scene_type)
    together = reachable(batch, [UP, FRONT]).reached
    alone = reachable(batch[1], [UP, FRONT]).reached
    assert torch.equal(together[:, 1:], alone)
    assert 0 < int(together.any(dim=0).sum()) < int(batch.is_free.sum())


@pytest.mark.slow
def test_a_heap_is_invalid_and_leaves_the_others_alone() -> None:
    """Sixty objects of many parts at one point take many times the work of a crowded scene."""
    clean = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 1)
    parts = torch.tensor([len(asset.fine) for asset in clean.scene_type.library.assets])
    categories = torch.where(clean.is_welded, clean.categories, parts.argmax())
    spread = torch.linspace(0.0, 0.05, clean.tensor.shape[1])[None, :, None]
    translations = torch.where(clean.is_welded[..., None], clean.translations, torch.tensor([0.0, 0.0, 0.8]) + spread)
    heap = SceneBatch.from_parts(translations, torch.eye(3).expand_as(clean.rotations), categories, clean.scene_type)
    both = SceneBatch(torch.cat([heap.tensor, clean.tensor]), clean.scene_type)
    result = reachable(both, [UP])
    assert result.valid.tolist() == [False, True]
    assert not bool(result.reached[:, 0].any())
    assert torch.equal(result.reached[:, 1], reachable(clean, [UP]).reached[:, 0])


def test_collisions_of_the_gripper_are_those_of_fcl() -> None:
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(1), 1)
    hand = _hand(batch.scene_type.library, Gripper())
    poses = (batch.translations.double().numpy(), batch.rotations.double().numpy())
    objects = flatten(hand.collider.library, *poses, batch.categories.numpy(), batch.is_welded.numpy())
    objects = objects[np.flatnonzero(objects.category < hand.body)]
    rng = np.random.default_rng(0)
    rotation = Rotation.random(150, random_state=0).as_matrix()
    translation = rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.25), (150, 3))
    blocked = hand._is_blocked(objects, rotation, translation, Budget(float("inf")))
    assert 10 < int(blocked.sum()) < 140

    def shape(part: object) -> fcl.Convex:
        faces = np.concatenate([np.full((len(part.faces), 1), 3), part.faces], axis=1).ravel()  # type: ignore[attr-defined]
        return fcl.Convex(part.vertices, len(part.faces), faces)  # type: ignore[attr-defined]

    bodies = [shape(part) for part in Gripper().body()]
    library = batch.scene_type.library
    things = [
        fcl.CollisionObject(shape(part), fcl.Transform(objects.rotation[row], objects.translation[row]))
        for row in range(len(objects))
        for part in library[int(objects.category[row])].fine
    ]
    for index in range(150):
        pose = fcl.Transform(rotation[index], translation[index])
        body = [fcl.CollisionObject(part, pose) for part in bodies]
        deepest = 0.0
        for part in body:
            for thing in things:
                request, result = fcl.CollisionRequest(enable_contact=True), fcl.CollisionResult()
                if fcl.collide(part, thing, request, result):
                    deepest = max(deepest, max(contact.penetration_depth for contact in result.contacts))
        if deepest == 0.0 or deepest > 1e-3:  # what barely touches is left out
            assert bool(blocked[index]) is (deepest > 0.0)


@pytest.mark.parametrize("wrong", [{"opening": 0.0}, {"palm": (0.05, 0.06)}, {"reaches": (0.1,)}, {"reaches": ()}])
def test_impossible_grippers_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidInputError):
        Gripper(**wrong)  # type: ignore[arg-type]
