"""Approaches of a gripper: hand-made scenes, and contacts against exact depths."""

from __future__ import annotations

from itertools import chain

import numpy as np
import pytest
import torch
from fcl import Transform
from scipy.spatial.transform import Rotation

from scene_envs.assets.fcl import Broadphase, Shapes, convex
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics.grasping import TOUCHING, Gripper, reachable
from scene_envs.physics.mujoco import Overlaps
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, scene

UP, FRONT = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
WIDE = Gripper(opening=SIDE + 0.02)


def reached(batch: SceneBatch, approach: tuple[float, float, float], gripper: Gripper = WIDE) -> list[bool]:
    """Verdicts on the free objects of one scene."""
    return reachable(batch, [approach], gripper)[0, 0][batch.is_free[0]].tolist()


def test_a_box_is_grasped_when_it_fits_between_the_fingers() -> None:
    alone = scene(("cube", 0.0, 0.0, 0.0), yaw=0.4)
    assert reached(alone, UP) == [True]
    assert reached(alone, UP, Gripper(opening=SIDE - 0.01)) == [False]
    assert reached(alone, UP, Gripper(opening=SIDE + 1e-3)) == [True]
    assert not bool(reachable(alone, [UP])[0, 0, 0])  # the floor is welded


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
    together = reachable(batch, [UP, FRONT])
    alone = reachable(batch[1], [UP, FRONT])
    assert torch.equal(together[:, 1:], alone)
    assert 0 < int(together.any(dim=0).sum()) < int(batch.is_free.sum())


@pytest.mark.slow
def test_a_heap_has_an_answer_and_leaves_the_others_alone() -> None:
    """Sixty objects of many parts within 5 cm, and one 10 km away."""
    clean = get_grammar("pantry_shelf").sample(np.random.default_rng(0), 1)
    parts = torch.tensor([len(asset.fine) for asset in clean.scene_type.library.assets])
    categories = torch.where(clean.is_welded, clean.categories, parts.argmax())
    spread = torch.linspace(0.0, 0.05, clean.tensor.shape[1])[None, :, None]
    translations = torch.where(clean.is_welded[..., None], clean.translations, torch.tensor([0.0, 0.0, 0.8]) + spread)
    translations[0, -1] = 1e4
    heap = SceneBatch.from_parts(translations, torch.eye(3).expand_as(clean.rotations), categories, clean.scene_type)
    both = reachable(SceneBatch(torch.cat([heap.tensor, clean.tensor]), clean.scene_type), [UP])
    assert torch.equal(both[:, 0], reachable(heap, [UP])[:, 0])
    assert torch.equal(both[:, 1], reachable(clean, [UP])[:, 0])
    assert not bool((both & ~torch.cat([heap.is_free, clean.is_free])).any())


def test_the_gripper_meets_what_is_deeper_than_a_tenth_of_a_millimetre() -> None:
    """Exact depths say the same, but for depths from 0.1 mm to 0.1 mm times the root of 3: the corner of a box."""
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(1), 1)
    batch = SceneBatch(batch.tensor[:, ~batch.is_empty[0]], batch.scene_type)
    library, gripper = batch.scene_type.library, Gripper()
    categories = batch.categories[0].tolist()
    rotations, translations = batch.rotations[0].double().numpy(), batch.translations[0].double().numpy()
    tree = Broadphase(chain(*Shapes(library).place(categories, rotations, translations)))
    owner = [row for row, category in enumerate(categories) for _ in library[category].fine]
    whole = [part.vertices + TOUCHING * np.sign(part.vertices - part.vertices.mean(axis=0)) for part in gripper.body()]
    parts = [*whole, *(part.vertices for category in categories for part in library[category].fine)]
    overlaps = Overlaps(parts, [[0, 1, 2], *([3 + row] for row in range(len(owner)))])
    kind = np.arange(1 + len(owner))
    places = np.random.default_rng(0).uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.25), (150, 3))
    body, found = [convex(part) for part in gripper.body()], []
    for turn, place in zip(Rotation.random(150, random_state=0).as_matrix(), places, strict=True):
        for part in body:
            part.setTransform(Transform(turn, place))
        found.append(any(map(tree.meets, body)))
        turns, at = np.concatenate([turn[None], rotations[owner]]), np.concatenate([place[None], translations[owner]])
        deepest = overlaps(kind, turns, at, np.zeros_like(kind[1:]), kind[1:])[2].max(initial=0.0)
        assert TOUCHING < deepest < 3**0.5 * TOUCHING or found[-1] is bool(deepest > TOUCHING)
    assert 10 < sum(found) < 140


@pytest.mark.parametrize("wrong", [{"opening": 0.0}, {"palm": (0.05, 0.06)}, {"reaches": (0.1,)}, {"reaches": ()}])
def test_impossible_grippers_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidInputError):
        Gripper(**wrong)  # type: ignore[arg-type]
