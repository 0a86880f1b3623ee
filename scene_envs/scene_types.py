"""Scene types: which assets, where, seen from where. Pure data, no torch."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import load_plugins

if TYPE_CHECKING:
    from scene_envs.assets.base import AssetLibrary

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the world frame.

    Attributes:
        position: (x, y, z) in m.
        target: point looked at, m.
        up: up direction.
        width: image width, pixels.
        height: image height, pixels.
        fov_y: vertical field of view, degrees.
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    width: int = 640
    height: int = 480
    fov_y: float = 45.0


@dataclass(frozen=True)
class FixedObject:
    """A welded asset with one constant pose (translation in m, rotation matrix row-major).

    Raises:
        InvalidInputError: not three and nine numbers.
    """

    asset: str
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = _IDENTITY

    def __post_init__(self) -> None:
        for name, length in (("translation", 3), ("rotation", 9)):
            value = _tuples(getattr(self, name))
            if len(value) != length:
                raise InvalidInputError(f"fixed object {self.asset!r}: {name} needs {length} numbers, got {value}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class SceneType:
    """Assets, workspace, welded assets, camera and grammar under one name.

    Attributes:
        name: registry key, such as ``"dimsum_table"``.
        assets: asset names; the index of a name is its category, ``len(assets)`` is *empty*.
        slots: rows of a scene, welded objects included.
        workspace: lowest and highest corner (m) inside which object frames must lie.
        welded: names of assets that are never simulated as free.
        fixed: welded objects with one constant pose; they take the first slots of a scene.
        camera: the paper's semantic-render camera.
        description: one sentence for listings.
        asset_folders: folders of users' own assets, searched before the built-in ones.

    Raises:
        InvalidInputError: an asset named twice, a welded asset that is not among the assets, a workspace whose corners
            are exchanged, or no slot for a free object.

    >>> scene_type = get_scene_type("dimsum_table")
    >>> scene_type.num_assets, scene_type.slots, scene_type.features
    (7, 34, 20)
    """

    name: str
    assets: tuple[str, ...]
    slots: int
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]]
    welded: tuple[str, ...]
    fixed: tuple[FixedObject, ...]
    camera: Camera
    description: str = ""
    asset_folders: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.asset_folders, str):
            raise InvalidInputError(f"scene type {self.name!r}: asset_folders is a tuple of paths, got one string")
        folders = tuple(os.path.abspath(os.path.expanduser(folder)) for folder in self.asset_folders)
        object.__setattr__(self, "asset_folders", folders)  # absolute: workers may run elsewhere
        for name in ("assets", "workspace", "welded", "fixed"):
            object.__setattr__(self, name, _tuples(getattr(self, name)))  # lists have no hash
        for asset in self.assets:
            if self.assets.count(asset) > 1:
                raise InvalidInputError(f"scene type {self.name!r}: asset {asset!r} is named twice among its assets")
        if not all(low <= high for low, high in zip(*self.workspace, strict=True)):
            raise InvalidInputError(
                f"scene type {self.name!r}: workspace is (lowest corner, highest corner), got {self.workspace}"
            )
        for asset in (*self.welded, *(f.asset for f in self.fixed)):
            if asset not in self.assets:
                raise InvalidInputError(f"scene type {self.name!r}: welded asset {asset!r} is not among its assets")
        if self.slots <= len(self.fixed):
            raise InvalidInputError(f"scene type {self.name!r}: slots={self.slots} leaves no room for free objects")

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> SceneType:
        """Inverse of :func:`dataclasses.asdict`, also after a trip through JSON."""
        values = {name: _tuples(value) for name, value in fields.items() if name not in ("camera", "fixed")}
        camera = Camera(**{name: _tuples(value) for name, value in fields["camera"].items()})
        fixed = tuple(FixedObject(**{name: _tuples(v) for name, v in item.items()}) for item in fields["fixed"])
        return cls(**values, camera=camera, fixed=fixed)

    @property
    def num_assets(self) -> int:
        """C, the number of assets; the category of an empty slot is C."""
        return len(self.assets)

    @property
    def features(self) -> int:
        """D = 3 + 9 + C + 1, the length of a slot."""
        return 13 + self.num_assets

    @property
    def welded_categories(self) -> tuple[int, ...]:
        """Categories of welded assets."""
        return tuple(self.assets.index(name) for name in self.welded)

    @property
    def has_geometry(self) -> bool:
        """Whether every asset has a model here; those of a scene type made from a dataset's metadata may have none.

        Without models there is no physics and there are no pictures; priors can be sampled all the same.

        >>> get_scene_type("dimsum_table").has_geometry
        True
        """
        from scene_envs.assets import list_assets
        from scene_envs.assets.importing.user_library import folder_index

        own = {name for folder in self.asset_folders for name in folder_index(folder).names}
        return own.union(list_assets()).issuperset(self.assets)

    @cached_property
    def library(self) -> AssetLibrary:
        """The assets themselves, built on first use and shared between scene types."""
        from scene_envs.assets import get_library

        return get_library(self.assets, self.asset_folders)


def _tuples(value: Any) -> Any:
    """Lists as tuples, all the way down."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value


_REGISTRY: dict[str, SceneType] = {}


def register_scene_type(scene_type: SceneType) -> SceneType:
    """Make ``scene_type`` available by name everywhere; the same name again replaces it."""
    _REGISTRY[scene_type.name] = scene_type
    return scene_type


def get_scene_type(name: str | SceneType) -> SceneType:
    """The scene type called ``name``; names joined by ``+`` are their union.

    Raises:
        UnknownNameError: no scene type has that name; says which is nearest.

    >>> get_scene_type("dimsum_table+pantry_shelf").slots
    61
    """
    if isinstance(name, SceneType):
        return name
    if name not in _REGISTRY:
        load_plugins()
    if name not in _REGISTRY and "+" in name:
        from scene_envs.unions import union_scene_type

        return union_scene_type(name.split("+"), name)
    if name not in _REGISTRY:
        raise unknown_name("scene type", name, _REGISTRY)
    return _REGISTRY[name]


def list_scene_types() -> list[str]:
    """Names of all registered scene types, those of installed packages included, sorted."""
    load_plugins()
    return sorted(_REGISTRY)


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

register_scene_type(
    SceneType(
        name="breakfast_table_low_clutter",
        assets=tuple(sorted((*_BREAKFAST, "utensil_crock"))),
        slots=26,
        workspace=_BREAKFAST_SPACE,
        welded=("breakfast_table",),
        fixed=(FixedObject("breakfast_table"),),
        camera=_BREAKFAST_CAMERA,
        description="A table laid for two, with shared bread, fruit, cereal, jugs and a crock of cutlery.",
    )
)
register_scene_type(
    SceneType(
        name="breakfast_table_high_clutter",
        assets=_BREAKFAST,
        slots=46,
        workspace=_BREAKFAST_SPACE,
        welded=("breakfast_table",),
        fixed=(FixedObject("breakfast_table"),),
        camera=_BREAKFAST_CAMERA,
        description="A table laid for up to six, with shared plates, bowls, cereal and jugs.",
    )
)
register_scene_type(
    SceneType(
        name="dimsum_table",
        assets=_DIMSUM,
        slots=34,
        workspace=((-0.49, -0.49, -0.02), (0.49, 0.49, 0.99)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera(position=(0.0, 0.0, 1.7), target=(0.0, 0.0, 0.0), up=_TABLE_UP),
        description="A round table with four places, teapots, dishes and stacks of dim sum steamers.",
    )
)
register_scene_type(
    SceneType(
        name="living_room_shelf",
        assets=_LIVING_ROOM,
        slots=23,
        workspace=_SHELF_SPACE,
        welded=("shelf",),
        fixed=(FixedObject("shelf"),),
        camera=_SHELF_CAMERA,
        description="A shelf of four tiers with board games, books, toys, drinks and lamps.",
    )
)
register_scene_type(
    SceneType(
        name="pantry_shelf",
        assets=_PANTRY,
        slots=61,
        workspace=_SHELF_SPACE,
        welded=("shelf",),
        fixed=(FixedObject("shelf"),),
        camera=_SHELF_CAMERA,
        description="A shelf of four tiers packed with cans, bottles and fruit.",
    )
)
register_scene_type(
    SceneType(
        name="restaurant_high_clutter",
        slots=125,
        description="A room with three or more laid dim sum tables, their chairs, and shelves along a wall.",
        **_ROOM,  # type: ignore[arg-type]
    )
)
register_scene_type(
    SceneType(
        name="restaurant_low_clutter",
        slots=107,
        description="A room with one or more dim sum tables, their chairs, and shelves along a wall.",
        **_ROOM,  # type: ignore[arg-type]
    )
)
