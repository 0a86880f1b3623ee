"""Built-in scene types: their assets, workspaces and cameras."""

from __future__ import annotations

from scene_envs.scene_types.base import Camera, FixedObject, SceneType

_BREAKFAST = (
    "apple_gala", "bowl", "bread_slice", "breakfast_table", "cereal_box", "dinner_spoon", "fork", "knife", "mug",
    "pear_bosc", "plate", "shared_plate", "teaspoon", "water_jug",
)  # fmt: skip
_LIVING_ROOM = (
    "apple_gala", "board_game_l", "board_game_l2", "board_game_s", "board_game_xl", "book", "bread_slice", "fruit_bowl",
    "game_case", "lamp", "pear_bosc", "shared_plate", "shelf", "soda_can", "speaker", "stacking_ring", "tea_bottle",
    "toy_train",
)  # fmt: skip
_PANTRY = (
    "apple_gala", "apple_golden", "apple_green", "apple_red", "avocado_a", "avocado_b", "avocado_c", "fruit_bowl",
    "pear_anjou", "pear_bosc", "pear_red", "shelf", "soda_can", "tea_bottle",
)  # fmt: skip
_DIMSUM = ("cafe_table", "dinner_plate", "serving_dish", "steamer_bottom", "steamer_lid", "teacup", "teapot")
_RESTAURANT = tuple(sorted((*_LIVING_ROOM, *_DIMSUM, "chair", "floor")))

_TABLE_UP = (-1.0, 0.0, 0.0)
_BREAKFAST_CAMERA = Camera((0.0, 0.0, 1.5), (0.0, 0.0, 0.0), _TABLE_UP)
_BREAKFAST_SPACE = ((-0.3575, -0.7, -0.02), (0.3575, 0.7, 0.5))
_SHELF_CAMERA = Camera((1.2, 0.0, 0.1), (0.0, 0.0, 0.1), (0.0, 0.0, 1.0))
_SHELF_SPACE = ((-0.15, -0.30, -0.42), (0.15, 0.30, 0.62))
_ROOM_CAMERA = Camera((0.0, 0.0, 13.0), (0.0, 0.0, 0.0), _TABLE_UP)
_ROOM_SPACE = ((-5.0, -5.0, -0.8), (5.0, 5.0, 0.99))
_ROOM = {
    "assets": _RESTAURANT,
    "workspace": _ROOM_SPACE,
    "welded": ("cafe_table", "floor", "shelf"),
    "fixed": (FixedObject("floor", (0.0, 0.0, -0.785)),),
    "camera": _ROOM_CAMERA,
}

BUILT_IN = (
    SceneType(
        name="breakfast_table_low_clutter",
        assets=tuple(sorted((*_BREAKFAST, "utensil_crock"))),
        slots=26,
        workspace=_BREAKFAST_SPACE,
        welded=("breakfast_table",),
        fixed=(FixedObject("breakfast_table"),),
        camera=_BREAKFAST_CAMERA,
        description="A table laid for two, with shared bread, fruit, cereal, jugs and a crock of cutlery.",
    ),
    SceneType(
        name="breakfast_table_high_clutter",
        assets=_BREAKFAST,
        slots=46,
        workspace=_BREAKFAST_SPACE,
        welded=("breakfast_table",),
        fixed=(FixedObject("breakfast_table"),),
        camera=_BREAKFAST_CAMERA,
        description="A table laid for up to six, with shared plates, bowls, cereal and jugs.",
    ),
    SceneType(
        name="dimsum_table",
        assets=_DIMSUM,
        slots=34,
        workspace=((-0.49, -0.49, -0.02), (0.49, 0.49, 0.99)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera(position=(0.0, 0.0, 1.7), target=(0.0, 0.0, 0.0), up=_TABLE_UP),
        description="A round table with four places, teapots, dishes and stacks of dim sum steamers.",
    ),
    SceneType(
        name="living_room_shelf",
        assets=_LIVING_ROOM,
        slots=23,
        workspace=_SHELF_SPACE,
        welded=("shelf",),
        fixed=(FixedObject("shelf"),),
        camera=_SHELF_CAMERA,
        description="A shelf of four tiers with board games, books, toys, drinks and lamps.",
    ),
    SceneType(
        name="pantry_shelf",
        assets=_PANTRY,
        slots=61,
        workspace=_SHELF_SPACE,
        welded=("shelf",),
        fixed=(FixedObject("shelf"),),
        camera=_SHELF_CAMERA,
        description="A shelf of four tiers packed with cans, bottles and fruit.",
    ),
    SceneType(
        name="restaurant_high_clutter",
        slots=125,
        description="A room with three or more laid dim sum tables, their chairs, and shelves along a wall.",
        **_ROOM,  # type: ignore[arg-type]
    ),
    SceneType(
        name="restaurant_low_clutter",
        slots=107,
        description="A room with one or more dim sum tables, their chairs, and shelves along a wall.",
        **_ROOM,  # type: ignore[arg-type]
    ),
)
