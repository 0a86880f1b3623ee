"""Export of scenes to simulators and viewers: URDF, SDF, Drake, MJCF, USD, GLB, arrays, and users' own formats."""

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from scene_envs.export.api import ExportReport, export
    from scene_envs.export.formats import ExportFormat, list_formats, register_format
    from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, place
    from scene_envs.export.verification import Verification, verify

__all__ = [
    "AssetFiles",
    "ExportFormat",
    "ExportReport",
    "PlacedObject",
    "PlacedScene",
    "Verification",
    "export",
    "list_formats",
    "place",
    "register_format",
    "verify",
]

__getattr__ = lazy_names(__name__, __file__)
