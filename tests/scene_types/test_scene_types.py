"""Scene types: what users may write, and what is refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from scene_envs.datasets import parse_prompt
from scene_envs.datasets.prompts import viewer_axes
from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import Camera, FixedObject, SceneType, get_scene_type

CUPS = SceneType(
    name="cups",
    assets=("cafe_table", "teacup"),
    slots=5,
    workspace=((-0.4, -0.4, -0.02), (0.4, 0.4, 0.5)),
    welded=("cafe_table",),
    fixed=(FixedObject("cafe_table"),),
    camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
)


def test_lists_do_as_well_as_tuples() -> None:
    lists: dict[str, Any] = {
        "assets": ["cafe_table", "teacup"],
        "workspace": [[-0.4, -0.4, -0.02], [0.4, 0.4, 0.5]],
        "welded": ["cafe_table"],
        "fixed": [FixedObject("cafe_table", [0.0, 0.0, 0.0], [1, 0, 0, 0, 1, 0, 0, 0, 1])],  # type: ignore[arg-type]
    }
    scene_type = dataclasses.replace(CUPS, **lists)
    assert scene_type == CUPS
    assert parse_prompt("A scene with two cups.", scene_type).objects == {"cup": 2}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"assets": ("cafe_table", "teacup", "teacup")}, "'teacup' is named twice"),
        ({"welded": ("shelf",)}, "'shelf' is not among its assets"),
        ({"workspace": (CUPS.workspace[1], CUPS.workspace[0])}, "lowest corner, highest corner"),
        ({"slots": 1}, "leaves no room"),
    ],
)
def test_contradictions_are_named(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInputError, match=words):
        dataclasses.replace(CUPS, **changes)


def test_a_fixed_object_needs_a_whole_pose() -> None:
    with pytest.raises(InvalidInputError, match="rotation needs 9 numbers"):
        FixedObject("cafe_table", rotation=(1.0, 0.0, 0.0, 0.0))


def test_a_camera_without_left_and_right_is_refused_where_sides_are_wanted() -> None:
    assert viewer_axes(get_scene_type("pantry_shelf"))[0].tolist() == [0.0, 1.0, 0.0]
    above = Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    with pytest.raises(InvalidInputError, match="horizontal up"):
        viewer_axes(dataclasses.replace(CUPS, camera=above))
