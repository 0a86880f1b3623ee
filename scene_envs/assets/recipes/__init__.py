"""The recipes; importing this package registers them all."""

from scene_envs.assets.recipes import breakfast_ware, food, furniture, tableware, toys

__all__ = ["breakfast_ware", "food", "furniture", "tableware", "toys"]
