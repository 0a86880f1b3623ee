"""The recipes of the built-in assets; importing this package registers them all in ``RECIPES``."""

from scene_envs.assets.base import RECIPES
from scene_envs.assets.recipes import tables

__all__ = ["RECIPES", "tables"]
