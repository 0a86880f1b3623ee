"""Built-in assets, each made by a recipe."""

from __future__ import annotations

from functools import cache

import numpy as np

from scene_envs.assets.base import RECIPES, Asset, RecipeEntry
from scene_envs.assets.shapes import mass_properties
from scene_envs.errors import unknown_name


def _recipes() -> dict[str, RecipeEntry]:
    """All recipes; imports the recipes of this package first, which load trimesh."""
    from scene_envs.assets import recipes  # noqa: F401

    return RECIPES


def list_assets() -> list[str]:
    """Names of all assets that can be built, sorted."""
    return sorted(_recipes())


def class_colors() -> list[tuple[int, int, int]]:
    """Class colours (r, g, b) of all assets that can be built."""
    return [entry.color for entry in _recipes().values()]


@cache
def build_asset(name: str) -> Asset:
    """The built-in asset called ``name``, built once per process.

    Raises:
        UnknownNameError: no recipe has that name; the nearest known one is offered.
    """
    recipes = _recipes()
    if name not in recipes:
        raise unknown_name("asset", name, recipes)
    entry = recipes[name]
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
