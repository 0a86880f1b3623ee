"""Registry of recipes: functions that model one built-in asset each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from scene_envs.assets.base import ConvexPart, regular_plural
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    import trimesh


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


RECIPES: dict[str, RecipeEntry] = {}
"""Recipes registered so far, by asset name."""


def asset_recipe(
    name: str, *, display_name: str, mass: float, color: tuple[int, int, int], plural: str | None = None
) -> Callable[[Recipe], Recipe]:
    """Register the decorated function as the recipe of asset ``name``.

    Args:
        name: Identifier, unique in the library.
        display_name: Name in prompts.
        mass: Mass, kg; 0 makes the asset static.
        color: Class colour (r, g, b) of semantic renders.
        plural: Plural of the display name; the regular one by default.

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
