"""The recipes; importing this package registers them all."""

from scene_envs.assets.recipes import (
    bowls,
    breakfast_ware,
    drinks,
    fruit,
    furniture,
    groceries,
    plates,
    steamers,
    teaware,
)

__all__ = ["bowls", "breakfast_ware", "drinks", "fruit", "furniture", "groceries", "plates", "steamers", "teaware"]
