"""Registry of scene types: built-in ones, those of installed packages, users' own, and unions of them."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.errors import InvalidInputError
from scene_envs.registry import Registry
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


def union_of(members: Sequence[SceneType], name: str) -> SceneType:
    """The scene type called ``name`` that holds the scenes of all ``members`` (at least one)."""
    lows, highs = ([member.workspace[end] for member in members] for end in (0, 1))
    largest = max(members, key=lambda member: member.workspace[1][0] - member.workspace[0][0])
    return SceneType(
        name=name,
        assets=tuple(sorted({asset for member in members for asset in member.assets})),
        slots=max(member.slots for member in members),
        workspace=(
            (min(c[0] for c in lows), min(c[1] for c in lows), min(c[2] for c in lows)),
            (max(c[0] for c in highs), max(c[1] for c in highs), max(c[2] for c in highs)),
        ),
        welded=tuple(sorted({asset for member in members for asset in member.welded})),
        fixed=tuple(fixed for fixed in members[0].fixed if all(fixed in member.fixed for member in members)),
        camera=largest.camera,
        description="Scenes of " + ", ".join(dict.fromkeys(member.name for member in members)) + ".",
        asset_folders=tuple(dict.fromkeys(folder for member in members for folder in member.asset_folders)),
    )


PLUGINS = "scene_envs.scene_types"
"""Entry-point group of modules that register scene types and their grammars when they are imported."""

_SCENE_TYPES = Registry("scene type", PLUGINS, {scene_type.name: scene_type for scene_type in BUILT_IN})


def register_scene_type(scene_type: SceneType) -> SceneType:
    """Make ``scene_type`` available by name everywhere; the same name again replaces it."""
    _SCENE_TYPES[scene_type.name] = scene_type
    if scene_type.asset_folders:
        from scene_envs.assets.library import know_folders

        know_folders(scene_type.asset_folders)
    return scene_type


def get_scene_type(name: str | SceneType) -> SceneType:
    """The scene type called ``name``; names joined by ``+`` are their union.

    Raises:
        UnknownNameError: no scene type has that name; the nearest known one is offered.
        InvalidInputError: ``name`` is neither text nor a scene type.

    >>> get_scene_type("dimsum_table+pantry_shelf").slots
    61
    """
    if isinstance(name, SceneType):
        return name
    if not isinstance(name, str):
        raise InvalidInputError(f"a scene type or its name is needed, got a {type(name).__name__}")
    if name not in _SCENE_TYPES and "+" in name:
        return union_scene_type(name.split("+"), name)
    return _SCENE_TYPES[name]


def list_scene_types() -> list[str]:
    """Names of all registered scene types, those of installed packages included, sorted."""
    return _SCENE_TYPES.names()


def union_scene_type(types: Sequence[str | SceneType], name: str | None = None) -> SceneType:
    """The scene type that holds the scenes of all ``types``.

    The union has the assets of all types, sorted by name, the largest number of slots, and the box around all
    workspaces. Assets that are welded in one type are welded in the union. Its folders of users' assets are those of
    all types. Only objects that are fixed in the same pose in *every* type stay fixed; the others may be in any slot.

    Args:
        types: One or more scene types or names.
        name: Name of the union. None joins the names of the types by ``+``, which :func:`get_scene_type` resolves.
            Another name is not registered: files that hold it need
            :func:`~scene_envs.scene_types.register_scene_type`.

    Raises:
        InvalidInputError: no types given.
        UnknownNameError: a name that is no scene type.

    >>> union = union_scene_type(["dimsum_table", "pantry_shelf"])
    >>> union.name, union.num_assets, union.slots, union.fixed
    ('dimsum_table+pantry_shelf', 21, 61, ())
    """
    members = [get_scene_type(member) for member in types]
    if not members:
        raise InvalidInputError("a union needs at least one scene type, got none")
    return union_of(members, name or "+".join(dict.fromkeys(member.name for member in members)))


def members_of(scene_type: SceneType) -> tuple[SceneType, ...]:
    """The scene types that the name of a union lists; ``scene_type`` itself where it is no union.

    The members are found only where all of them are registered and together have the assets of the union.

    >>> [member.name for member in members_of(get_scene_type("dimsum_table+pantry_shelf"))]
    ['dimsum_table', 'pantry_shelf']
    """
    names = scene_type.name.split("+")
    if len(names) < 2 or any(name not in _SCENE_TYPES for name in names):
        return (scene_type,)
    members = tuple(get_scene_type(name) for name in names)
    return members if {a for member in members for a in member.assets} == set(scene_type.assets) else (scene_type,)
