"""The recipes; importing this package registers them all."""

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
