"""The recipes; importing this package registers them all."""

from scene_envs.assets.recipes import furniture, plates, steamers, teaware

__all__ = ["furniture", "plates", "steamers", "teaware"]
