"""Supports of each scene type: the heights on which objects may rest."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Support:
    """Support of objects of a scene type: a surface fixed in the world, or the top of another object.

    Attributes:
        kind: name under which the height error is reported, such as ``"table"`` or ``"stack"``.
        height: z of the surface (m), in the world, or above the frame of the supporting object.
        on: names of the supporting assets; None if the surface is fixed in the world.
        riders: names of the assets that can rest there; None means all free ones.
        reach: largest horizontal distance (m) between the frames of rider and supporting object.
        catch: largest height error (m) at which a rider within reach is assigned to this support, even if another
            surface is nearer; for supports that are thinner than the errors, such as a plate on a table.

    >>> [support.kind for support in SUPPORTS["dimsum_table"]]
    ['table', 'stack']
    """

    kind: str
    height: float
    on: tuple[str, ...] | None = None
    riders: tuple[str, ...] | None = None
    reach: float = 0.06
    catch: float = 0.0


@dataclass(frozen=True)
class Container:
    """Hollow assets, in which objects lie as they fell; these objects have no correct height and are left out.

    Attributes:
        names: names of the hollow assets.
        riders: objects that may lie in them.
        reach: largest horizontal distance (m) between the frames.
        depth: largest height (m) of the rider's frame above the container's; the smallest is 1 cm.

    >>> [container.names for container in CONTAINERS]
    [('fruit_bowl',), ('bowl',), ('utensil_crock',)]
    """

    names: tuple[str, ...]
    riders: tuple[str, ...]
    reach: float
    depth: float


_FRUIT = (
    "apple_gala", "apple_golden", "apple_green", "apple_red", "avocado_a", "avocado_b", "avocado_c", "pear_anjou",
    "pear_bosc", "pear_red",
)  # fmt: skip
_UTENSILS = ("dinner_spoon", "fork", "knife", "teaspoon")
_DISHES = ("dinner_plate", "serving_dish", "steamer_bottom", "steamer_lid", "teacup", "teapot")
_STEAMERS = Support("stack", 0.091, on=("steamer_bottom",), riders=("steamer_bottom", "steamer_lid"))
_TIERS = (-0.3915, -0.1232, 0.1392, 0.4075)
_BIG_GAMES = ("board_game_l", "board_game_l2", "board_game_xl")
_SHELF_LOADS = (
    *_BIG_GAMES, "apple_gala", "board_game_s", "book", "bread_slice", "fruit_bowl", "game_case", "lamp", "pear_bosc",
    "shared_plate", "soda_can", "speaker", "stacking_ring", "tea_bottle", "toy_train",
)  # fmt: skip
_PLATE, _CATCH = 0.006, 0.03
"""Height (m) of the inside of plates and breakfast bowls, and ``catch`` (m) of the objects that lie there."""

_TABLE = Support("table", 0.0)
_FOOD = (
    Support("plate", _PLATE, on=("shared_plate",), riders=("apple_gala", "bread_slice", "pear_bosc"), catch=_CATCH),
    Support("stack", 0.016, on=("bread_slice",), riders=("bread_slice",), catch=_CATCH),
)
_BREAKFAST = (
    _TABLE,
    *_FOOD,
    Support("plate", _PLATE, on=("plate",), riders=("apple_gala", "bowl", "bread_slice", "pear_bosc"), catch=_CATCH),
    Support("bowl", _PLATE, on=("bowl",), riders=("apple_gala", "pear_bosc"), catch=_CATCH),
)
_GAMES = (
    Support("stack", 0.055, on=("board_game_l", "board_game_xl"), riders=_BIG_GAMES),
    Support("stack", 0.069, on=("board_game_l2",), riders=_BIG_GAMES),
    Support("stack", 0.060, on=("board_game_s",), riders=("board_game_s",)),
    Support("stack", 0.0125, on=("game_case",), riders=("game_case",)),
)
_SHELF = tuple(Support("tier", height) for height in _TIERS)
_RESTAURANT = (
    Support("furniture", 0.0, riders=("cafe_table",)),
    Support("furniture", -0.3775, riders=("shelf",)),
    Support("floor", -0.785, riders=("chair",)),
    Support("table", 0.0, on=("cafe_table",), riders=_DISHES, reach=0.7),
    _STEAMERS,
    *(Support("tier", height, on=("shelf",), riders=_SHELF_LOADS, reach=0.34) for height in _TIERS),
    *_GAMES,
    *_FOOD,
)

SUPPORTS: dict[str, tuple[Support, ...]] = {
    "breakfast_table_high_clutter": _BREAKFAST,
    "breakfast_table_low_clutter": _BREAKFAST,
    "dimsum_table": (_TABLE, _STEAMERS),
    "living_room_shelf": (*_SHELF, *_GAMES, *_FOOD),
    "pantry_shelf": _SHELF,
    "restaurant_high_clutter": _RESTAURANT,
    "restaurant_low_clutter": _RESTAURANT,
}
"""Supports of each scene type, by name; scene types without an entry have no height figures."""

CONTAINERS: tuple[Container, ...] = (
    Container(("fruit_bowl",), _FRUIT, reach=0.11, depth=0.15),
    Container(("bowl",), ("bread_slice",), reach=0.08, depth=0.10),
    Container(("utensil_crock",), _UTENSILS, reach=0.10, depth=0.20),
)
"""Containers of all scene types."""
