"""The registry of recipes, and the library of assets built from them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from scene_envs.assets.base import Asset, AssetLibrary, ConvexPart, regular_plural
from scene_envs.assets.shapes import mass_properties
from scene_envs.errors import InvalidInputError, unknown_name

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class Model:
    """What a recipe returns: geometry in the asset frame, m.

    Attributes:
        visual: coloured mesh.
        fine: convex parts that keep hollows hollow; they may touch, and should not overlap.
        coarse: fewer parts, without hollows.
    """

    visual: trimesh.Trimesh
    fine: Sequence[ConvexPart]
    coarse: Sequence[ConvexPart]


Recipe = Callable[[], Model]


@dataclass(frozen=True)
class _Entry:
    recipe: Recipe
    display_name: str
    plural: str
    mass: float
    color: tuple[int, int, int]


_RECIPES: dict[str, _Entry] = {}


def asset_recipe(
    name: str, *, display_name: str, mass: float, color: tuple[int, int, int], plural: str | None = None
) -> Callable[[Recipe], Recipe]:
    """Register the decorated function as the recipe of asset ``name``.

    Args:
        name: identifier, unique in the library.
        display_name: what prompts call it.
        mass: kg; 0 makes the asset static.
        color: (r, g, b) class colour of semantic renders.
        plural: plural of the display name; the regular one by default.

    Raises:
        InvalidInputError: the name is taken, or the mass is negative.
    """

    def register(recipe: Recipe) -> Recipe:
        if name in _RECIPES:
            raise InvalidInputError(f"an asset called {name!r} is registered already; choose another name")
        if not mass >= 0:
            raise InvalidInputError(f"asset {name!r}: mass must be 0 (static) or positive kg, got {mass}")
        _RECIPES[name] = _Entry(recipe, display_name, plural or regular_plural(display_name), mass, color)
        return recipe

    return register


def list_assets() -> list[str]:
    """Names of all assets that can be built, sorted."""
    _load_recipes()
    return sorted(_RECIPES)


def class_colors() -> list[tuple[int, int, int]]:
    """Class colours (r, g, b) of all assets that can be built."""
    _load_recipes()
    return [entry.color for entry in _RECIPES.values()]


def get_library(names: Sequence[str], folders: Sequence[str | os.PathLike[str]] = ()) -> AssetLibrary:
    """The assets called ``names``, in this order; each is built once per process.

    Args:
        names: asset names in category order.
        folders: of users' own assets, searched in this order before the built-in ones.

    Raises:
        UnknownNameError: neither a folder nor a recipe has that name; the nearest known one is offered.
        InvalidInputError: a folder or one of its entries is wrong.
        CorruptFileError: a file of a folder cannot be read.
    """
    if not folders:
        return AssetLibrary(tuple(_build(name) for name in names))
    from scene_envs.assets.importing.user_library import find_asset, folder_index

    own = [name for folder in folders for name in folder_index(folder).names]
    for name in names:
        if name not in own and name not in list_assets():
            raise unknown_name("asset", name, [*own, *list_assets()])
    return AssetLibrary(tuple(find_asset(name, folders) or _build(name) for name in names))


@cache
def _load_recipes() -> None:
    import_module("scene_envs.assets.recipes")


@cache
def _build(name: str) -> Asset:
    _load_recipes()
    if name not in _RECIPES:
        raise unknown_name("asset", name, _RECIPES)
    entry = _RECIPES[name]
    model = entry.recipe()
    mass, center, inertia = mass_properties(model.fine, entry.mass)
    return Asset(
        name=name,
        display_name=entry.display_name,
        plural=entry.plural,
        mass=mass,
        center_of_mass=center,
        inertia=inertia if mass > 0 else np.zeros((3, 3)),
        visual=model.visual,
        fine=tuple(model.fine),
        coarse=tuple(model.coarse),
        color=entry.color,
        static=mass == 0,
    )
