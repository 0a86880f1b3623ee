"""Import of users' assets: folders of URDF, SDF, MJCF, USD and mesh files as asset libraries."""

from scene_envs.assets.importing.build import AssetReport, ImportReport
from scene_envs.assets.importing.user_library import import_report, load_library

__all__ = ["AssetReport", "ImportReport", "import_report", "load_library"]
