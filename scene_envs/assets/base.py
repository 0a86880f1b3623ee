"""Asset: meshes, convex parts, mass properties."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError, unknown_name

if TYPE_CHECKING:
    import trimesh

_GROUPS = json.loads(Path(__file__).with_name("groups.json").read_text("utf-8"))
ASSET_GROUPS: dict[str, frozenset[str]] = {name: frozenset(members) for name, members in _GROUPS.items()}
"""Names of assets by group."""
RECIPES: dict[str, RecipeEntry] = {}
"""Recipes registered so far, by asset name."""


def indefinite_article(name: str) -> str:
    """The indefinite article of a noun, by sound.

    >>> indefinite_article("apple"), indefinite_article("utensil crock"), indefinite_article("plate")
    ('an', 'a', 'a')
    >>> indefinite_article("USB stick"), indefinite_article("umbrella"), indefinite_article("uncut loaf")
    ('a', 'an', 'an')
    """
    yoo = r"uni(?![nm])|us[abeiu]|ut[aeiou]|eu|one\b|once\b"
    return "an" if re.match(rf"(?!{yoo})[aeiou]|hour|hono|heir", name, re.IGNORECASE) else "a"


def regular_plural(name: str) -> str:
    """The regular plural of a noun.

    >>> regular_plural("mug"), regular_plural("toy box"), regular_plural("cherry"), regular_plural("tray")
    ('mugs', 'toy boxes', 'cherries', 'trays')
    """
    if re.search(r"[^aeiou]y$", name, re.IGNORECASE):
        return f"{name[:-1]}ies"
    return f"{name}es" if re.search(r"(s|x|z|ch|sh)$", name, re.IGNORECASE) else f"{name}s"


def identifiers(names: Iterable[str]) -> dict[str, str]:
    """For each name, a unique :func:`identifier`.

    >>> identifiers(["tea cup", "tea-cup", "7up", "world", "__lid__"])
    {'tea cup': 'tea_cup', 'tea-cup': 'tea_cup_2', '7up': '_7up', 'world': '_world', '__lid__': '_lid_'}
    """
    found: dict[str, str] = {}
    for name in names:
        free, repeat = identifier(name), 1
        while free in found.values():
            repeat += 1
            free = f"{identifier(name)}_{repeat}"
        found[name] = free
    return found


def identifier(name: str) -> str:
    """``name`` with everything but letters, digits and underscores replaced. It does not start with a digit, and is no
    word that formats keep for themselves, such as ``world`` and ``__model__``.
    """
    plain = re.sub(r"^__+(.+?)__+$", r"_\1_", re.sub(r"\W", "_", name, flags=re.ASCII)) or "_"
    return f"_{plain}" if plain[0].isdigit() or plain == "world" else plain


@dataclass(frozen=True)
class ConvexPart:
    """One convex piece of collision geometry in the asset frame (m).

    Attributes:
        vertices: (V, 3) float64 corners of the hull.
        faces: (F, 3) int64 triangles, outward by the right-hand rule.
    """

    vertices: Array
    faces: Index

    @cached_property
    def bounds(self) -> Array:
        """(2, 3): lowest and highest corner, m."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])


def bounds_of(parts: Sequence[ConvexPart]) -> Array:
    """(2, 3) m: lowest and highest corner of the box around ``parts``."""
    corners = np.stack([part.bounds for part in parts])
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])


@dataclass(frozen=True, eq=False)
class Joint:
    """A movable joint of a model and the link that it moves. At position 0 the link is where the asset shows it.

    Attributes:
        name: Its name in the file.
        link: Name of the link.
        parent: Row in :attr:`Asset.bodies` of what the link hangs on; 0 is the part that does not move.
        kind: ``"revolute"`` or ``"prismatic"``.
        pose: (4, 4) frame of the link, whose origin is on the axis, in the frame of its parent, m.
        axis: (3,) unit vector in the frame of the link.
        limits: Lowest and highest position, rad or m; infinite for a revolute joint without limits.
        damping: N m s/rad or N s/m.
        friction: N m or N.
    """

    name: str
    link: str
    parent: int
    kind: Literal["revolute", "prismatic"]
    pose: Array
    axis: Array
    limits: tuple[float, float]
    damping: float = 0.0
    friction: float = 0.0


@dataclass(frozen=True, eq=False)
class Asset:
    """One model of the library. Frame: z up, base at z = 0 unless its recipe has another frame.

    Attributes:
        name: Identifier, such as ``"steamer_lid"``.
        display_name: Name in prompts, such as ``"steamer lid"``.
        plural: Plural of the display name.
        mass: Mass, kg; 0 for static assets.
        center_of_mass: (3,) centre of mass in the asset frame, m.
        inertia: (3, 3) inertia about the centre of mass, asset axes, kg m^2.
        visual: Coloured mesh for pictures, m.
        fine: Convex parts that keep hollows hollow.
        coarse: Fewer convex parts, used where the result is the same.
        color: (r, g, b) in 0..255, the class colour of semantic renders.
        static: True for tables, shelves and floors.
        joints: Movable joints of a user's model, which exports keep where the asset is welded; each after its parent.
        bodies: With joints, what does not move and then the link of each joint, in its own frame.
    """

    name: str
    display_name: str
    plural: str
    mass: float
    center_of_mass: Array
    inertia: Array
    visual: trimesh.Trimesh
    fine: tuple[ConvexPart, ...]
    coarse: tuple[ConvexPart, ...]
    color: tuple[int, int, int]
    static: bool = False
    joints: tuple[Joint, ...] = ()
    bodies: tuple[Asset, ...] = ()

    @cached_property
    def bounds(self) -> Array:
        """(2, 3): lowest and highest corner of the fine parts, m."""
        return bounds_of(self.fine)


@dataclass(frozen=True, eq=False)
class AssetLibrary:
    """An ordered set of assets; the order defines the categories of a scene type.

    >>> from scene_envs.assets import get_library
    >>> library = get_library(("teacup", "teapot"))
    >>> len(library), library[1].display_name
    (2, 'teapot')
    """

    assets: tuple[Asset, ...]
    _index: dict[str, int] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        for index, asset in enumerate(self.assets):
            if asset.name in self._index:
                raise InvalidInputError(f"asset name {asset.name!r} appears twice in a library; names must be unique")
            self._index[asset.name] = index

    def __len__(self) -> int:
        return len(self.assets)

    def __iter__(self) -> Iterator[Asset]:
        return iter(self.assets)

    def __getitem__(self, key: int | str) -> Asset:
        return self.assets[self.index(key)] if isinstance(key, str) else self.assets[key]

    def index(self, name: str) -> int:
        """Category of the asset called ``name``."""
        if name not in self._index:
            raise unknown_name("asset", name, self._index)
        return self._index[name]

    @property
    def names(self) -> Sequence[str]:
        """Asset names in category order."""
        return tuple(asset.name for asset in self.assets)


def register_asset_group(name: str, assets: Iterable[str]) -> None:
    """Make ``name`` stand for several assets wherever assets are named; a group of that name is replaced. Raises
    InvalidInputError where ``assets`` is one string.

    >>> register_asset_group("doctest_round", ["dinner_plate", "steamer_bottom"])
    >>> sorted(ASSET_GROUPS.pop("doctest_round"))
    ['dinner_plate', 'steamer_bottom']
    """
    if isinstance(assets, str):
        raise InvalidInputError(f"asset group {name!r}: give a list of asset names, got the string {assets!r}")
    ASSET_GROUPS[name] = frozenset(assets)


def categories_of(names: Sequence[str], library: AssetLibrary) -> tuple[int, ...]:
    """Categories of ``library`` that ``names`` stand for, ascending: names of assets, display names in prompts
    ("steamer lid") or groups of :data:`ASSET_GROUPS`. Raises UnknownNameError for any other name.

    >>> from scene_envs.assets import get_library
    >>> categories_of(["fruit", "cup"], get_library(("apple_red", "teacup", "teapot")))
    (0, 1)
    """
    found: set[int] = set()
    for name in names:
        members = {c for c, asset in enumerate(library) if name in (asset.name, asset.display_name)}
        if not members and name not in ASSET_GROUPS:
            known = [*library.names, *(asset.display_name for asset in library), *ASSET_GROUPS]
            raise unknown_name("asset, display name or group", name, known)
        group = ASSET_GROUPS.get(name, frozenset()) if not members else frozenset()
        found |= members | {c for c, asset in enumerate(library) if asset.name in group}
    return tuple(sorted(found))


@dataclass(frozen=True)
class Model:
    """Result of a recipe: geometry in the asset frame, m.

    Attributes:
        visual: Coloured mesh.
        fine: Convex parts that keep hollows hollow; they may touch, and should not overlap.
        coarse: Fewer parts, without hollows.
    """

    visual: trimesh.Trimesh
    fine: Sequence[ConvexPart]
    coarse: Sequence[ConvexPart]


Recipe = Callable[[], Model]


@dataclass(frozen=True)
class RecipeEntry:
    """A recipe with the facts about its asset that are not geometry; see :func:`asset_recipe`."""

    recipe: Recipe
    display_name: str
    plural: str
    mass: float
    color: tuple[int, int, int]


def asset_recipe(
    name: str, *, display_name: str, mass: float, color: tuple[int, int, int], plural: str | None = None
) -> Callable[[Recipe], Recipe]:
    """Register the decorated function as the recipe of asset ``name``, whose other facts are fields of :class:`Asset`;
    ``mass`` (kg) 0 makes it static, and the plural is the regular one by default.

    Raises:
        InvalidInputError: the name is taken, or the mass is negative.
    """

    def register(recipe: Recipe) -> Recipe:
        if name in RECIPES:
            raise InvalidInputError(f"an asset called {name!r} is registered already; choose another name")
        if not mass >= 0:
            raise InvalidInputError(f"asset {name!r}: mass must be 0 (static) or positive kg, got {mass}")
        RECIPES[name] = RecipeEntry(recipe, display_name, plural or regular_plural(display_name), mass, color)
        return recipe

    return register
