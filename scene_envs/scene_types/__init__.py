"""Scene types: assets, workspace, fixed objects and camera, by name."""

from scene_envs.scene_types.base import Camera, FixedObject, SceneType
from scene_envs.scene_types.registry import (
    get_scene_type,
    list_scene_types,
    members_of,
    register_scene_type,
    union_scene_type,
)

__all__ = [
    "Camera",
    "FixedObject",
    "SceneType",
    "get_scene_type",
    "list_scene_types",
    "members_of",
    "register_scene_type",
    "union_scene_type",
]
