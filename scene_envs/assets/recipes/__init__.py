"""The recipes of the built-in assets; importing this package registers them all in ``RECIPES``."""

from scene_envs.assets.base import RECIPES
from scene_envs.assets.recipes import breakfast_ware, food, furniture, tables

__all__ = ["RECIPES", "breakfast_ware", "food", "furniture", "tables"]
