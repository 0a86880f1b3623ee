"""Export of scenes to simulators and viewers: URDF, SDF, Drake, MJCF, USD, GLB, arrays, and users' own formats."""

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from scene_envs.export.api import ExportReport, export
    from scene_envs.export.formats import ExportFormat, list_formats, register_format
    from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, place

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

__getattr__ = lazy_names(__name__, __file__)
