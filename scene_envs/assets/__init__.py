"""The asset library: procedural models with visual mesh, convex parts and mass."""

from scene_envs.assets.base import Asset, AssetLibrary, ConvexPart
from scene_envs.assets.library import Model, asset_recipe, get_library, list_assets

__all__ = ["Asset", "AssetLibrary", "ConvexPart", "Model", "asset_recipe", "get_library", "list_assets"]
