"""Registry of groups of assets of one kind, such as edible assets."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scene_envs.assets.base import AssetLibrary
from scene_envs.errors import InvalidInputError, unknown_name

_FRUIT = (
    "apple_gala", "apple_golden", "apple_green", "apple_red", "avocado_a", "avocado_b", "avocado_c", "pear_anjou",
    "pear_bosc", "pear_red",
)  # fmt: skip

ASSET_GROUPS: dict[str, frozenset[str]] = {
    "fruit": frozenset(_FRUIT),
    "edible": frozenset((*_FRUIT, "bread_slice", "cereal_box")),
    "drinks": frozenset(("soda_can", "tea_bottle", "water_jug")),
    "dishes": frozenset(("bowl", "dinner_plate", "fruit_bowl", "plate", "serving_dish", "shared_plate")),
    "cups": frozenset(("mug", "teacup")),
    "cutlery": frozenset(("dinner_spoon", "fork", "knife", "teaspoon")),
    "steamers": frozenset(("steamer_bottom", "steamer_lid")),
    "games": frozenset(("board_game_l", "board_game_l2", "board_game_s", "board_game_xl", "game_case")),
    "toys": frozenset(("stacking_ring", "toy_train")),
    "furniture": frozenset(("breakfast_table", "cafe_table", "chair", "floor", "shelf")),
}
"""Names of assets by group."""


def register_asset_group(name: str, assets: Iterable[str]) -> None:
    """Make ``name`` stand for several assets wherever assets are named; a group of that name is replaced.

    Raises:
        InvalidInputError: ``assets`` is one string.

    >>> register_asset_group("doctest_round", ["dinner_plate", "steamer_bottom"])
    >>> sorted(ASSET_GROUPS.pop("doctest_round"))
    ['dinner_plate', 'steamer_bottom']
    """
    if isinstance(assets, str):
        raise InvalidInputError(f"asset group {name!r}: give a list of asset names, got the string {assets!r}")
    ASSET_GROUPS[name] = frozenset(assets)


def categories_of(names: Sequence[str], library: AssetLibrary) -> tuple[int, ...]:
    """Categories of ``library`` that ``names`` stand for, ascending.

    Args:
        names: Asset names, display names in prompts ("steamer lid") or groups of :data:`ASSET_GROUPS`.
        library: Assets of a scene type.

    Raises:
        UnknownNameError: a name is none of these; the nearest known one is offered.

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
