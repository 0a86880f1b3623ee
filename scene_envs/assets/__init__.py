"""The asset library: procedural models with visual mesh, convex parts and mass, and users' own files."""

from scene_envs.assets.base import (
    ASSET_GROUPS,
    Asset,
    AssetLibrary,
    ConvexPart,
    Model,
    asset_recipe,
    register_asset_group,
)
from scene_envs.assets.importing import AssetReport, ImportReport, import_report, load_library
from scene_envs.assets.library import get_library, list_assets

__all__ = [
    "ASSET_GROUPS",
    "Asset",
    "AssetLibrary",
    "AssetReport",
    "ConvexPart",
    "ImportReport",
    "Model",
    "asset_recipe",
    "get_library",
    "import_report",
    "list_assets",
    "load_library",
    "register_asset_group",
]
