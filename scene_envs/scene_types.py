"""Scene types: which assets, where, seen from where. Pure data, no torch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from scene_envs.errors import InvalidInputError, unknown_name

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
    """A welded asset with one constant pose (translation in m, rotation matrix row-major)."""

    asset: str
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, ...] = _IDENTITY


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

    def __post_init__(self) -> None:
        for asset in (*self.welded, *(f.asset for f in self.fixed)):
            if asset not in self.assets:
                raise InvalidInputError(f"scene type {self.name!r}: welded asset {asset!r} is not among its assets")
        if self.slots <= len(self.fixed):
            raise InvalidInputError(f"scene type {self.name!r}: slots={self.slots} leaves no room for free objects")

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

    @cached_property
    def library(self) -> AssetLibrary:
        """The assets themselves, built on first use and shared between scene types."""
        from scene_envs.assets import get_library

        return get_library(self.assets)


_REGISTRY: dict[str, SceneType] = {}


def register_scene_type(scene_type: SceneType) -> SceneType:
    """Make ``scene_type`` available by name everywhere; the same name again replaces it."""
    _REGISTRY[scene_type.name] = scene_type
    return scene_type


def get_scene_type(name: str | SceneType) -> SceneType:
    """The scene type called ``name``; raises UnknownNameError with the nearest known name."""
    if isinstance(name, SceneType):
        return name
    if name not in _REGISTRY:
        raise unknown_name("scene type", name, _REGISTRY)
    return _REGISTRY[name]


def list_scene_types() -> list[str]:
    """Names of all registered scene types, sorted."""
    return sorted(_REGISTRY)


register_scene_type(
    SceneType(
        name="dimsum_table",
        assets=("cafe_table", "dinner_plate", "serving_dish", "steamer_bottom", "steamer_lid", "teacup", "teapot"),
        slots=34,
        workspace=((-0.49, -0.49, -0.02), (0.49, 0.49, 0.99)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera(position=(0.0, 0.0, 1.7), target=(0.0, 0.0, 0.0), up=(-1.0, 0.0, 0.0)),
        description="A round table with four places, teapots, dishes and stacks of dim sum steamers.",
    )
)
