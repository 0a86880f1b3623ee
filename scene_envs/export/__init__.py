"""Export of scenes to simulators and viewers: URDF, SDF, Drake, MJCF, USD, GLB, arrays, and formats of your own."""

from scene_envs.export.api import ExportReport, export
from scene_envs.export.asset_files import AssetFiles
from scene_envs.export.formats import ExportFormat, list_formats, register_format
from scene_envs.export.placed import PlacedObject, PlacedScene, place

__all__ = [
    "AssetFiles",
    "ExportFormat",
    "ExportReport",
    "PlacedObject",
    "PlacedScene",
    "export",
    "list_formats",
    "place",
    "register_format",
]
