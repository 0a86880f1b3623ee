"""Recipes of all built-in assets, which are registered by an import of this package."""

from scene_envs.assets.recipes import (
    bowls,
    breakfast_ware,
    cutlery,
    drinks,
    fruit,
    furniture,
    games,
    groceries,
    plates,
    shelf,
    steamers,
    teaware,
    toys,
)

__all__ = [
    "bowls",
    "breakfast_ware",
    "cutlery",
    "drinks",
    "fruit",
    "furniture",
    "games",
    "groceries",
    "plates",
    "shelf",
    "steamers",
    "teaware",
    "toys",
]
