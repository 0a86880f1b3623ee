"""Scene types: assets, workspace, fixed objects and camera, as pure data, by name; and unions of them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from scene_envs.errors import InvalidInputError
from scene_envs.files import page_part
from scene_envs.registry import Registry

if TYPE_CHECKING:
    from scene_envs.assets.base import AssetLibrary

__all__ = [
    "Camera",
    "FixedObject",
    "SceneType",
    "get_scene_type",
    "list_scene_types",
    "members_of",
    "register_scene_type",
    "union_scene_type",
]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in the world frame.

    Attributes:
        position: Position (x, y, z), m.
        target: Point in the middle of the image, m.
        up: Direction that points up in the image.
        width: Image width, pixels.
        height: Image height, pixels.
        fov_y: Vertical field of view, degrees.
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
        InvalidInputError: the pose is not three and nine numbers.
    """

    asset: str
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        for name, length in (("translation", 3), ("rotation", 9)):
            value = _tuples(getattr(self, name))
            if len(value) != length:
                raise InvalidInputError(f"fixed object {self.asset!r}: {name} needs {length} numbers, got {value}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class SceneType:
    """Assets, workspace, welded assets and camera under one name.

    Attributes:
        name: Registry key, such as ``"dimsum_table"``.
        assets: Asset names; the index of a name is its category, ``len(assets)`` is *empty*.
        slots: Number of rows of a scene, welded objects included.
        workspace: Lowest and highest corner (m) of the box in which object frames must lie.
        welded: Names of assets that are never simulated as free.
        fixed: Welded objects with one constant pose; they take the first slots of a scene, and priors put their assets
            in no other slot.
        camera: The paper's semantic-render camera.
        description: One sentence for listings.
        asset_folders: Folders of users' own assets, searched before the built-in ones.

    Raises:
        InvalidInputError: an asset named twice, a welded asset that is not among the assets, a workspace whose corners
            are exchanged, or no slot for a free object.

    >>> from scene_envs import get_scene_type
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
    def furniture_categories(self) -> tuple[int, ...]:
        """Categories of generated welded assets, which are those without a fixed object."""
        return tuple(sorted(set(self.welded_categories) - set(self.fixed_categories)))

    @property
    def fixed_categories(self) -> tuple[int, ...]:
        """Categories of the welded assets of fixed objects, ascending."""
        return tuple(sorted({self.assets.index(f.asset) for f in self.fixed if f.asset in self.welded}))

    @property
    def has_geometry(self) -> bool:
        """Whether every asset has a model, built-in or in the folders of the scene type.

        Assets of a scene type made from a dataset's metadata may have no models. Without models there are no
        physics and no pictures, but priors can be sampled.
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
    """``value`` with lists turned into tuples at every level."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list | tuple) else value


BUILT_IN = tuple(map(SceneType.from_dict, json.loads(page_part("scene_envs", "scene_types.json"))))
"""The scene types of this project by name, as ``scene_types.json`` describes them."""
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
    names = dict.fromkeys(member.name for member in members)
    lows, highs = (zip(*(member.workspace[end] for member in members), strict=True) for end in (0, 1))
    workspace: Any = tuple(map(min, lows)), tuple(map(max, highs))
    return SceneType(
        name=name or "+".join(names),
        assets=tuple(sorted({asset for member in members for asset in member.assets})),
        slots=max(member.slots for member in members),
        workspace=workspace,
        welded=tuple(sorted({asset for member in members for asset in member.welded})),
        fixed=tuple(fixed for fixed in members[0].fixed if all(fixed in member.fixed for member in members)),
        camera=max(members, key=lambda member: member.workspace[1][0] - member.workspace[0][0]).camera,
        description=f"Scenes of {', '.join(names)}.",
        asset_folders=tuple(dict.fromkeys(folder for member in members for folder in member.asset_folders)),
    )


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
