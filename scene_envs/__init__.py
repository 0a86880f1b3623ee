"""SceneEnvs: Gymnasium environments for steering 3D scene generation.

Importing this package registers the environments and does nothing more; torch and PyBullet load
when an environment is built or when a public name below is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from scene_envs.registration import register_envs

if TYPE_CHECKING:
    from scene_envs.errors import SceneEnvsError
    from scene_envs.normalizer import Normalizer
    from scene_envs.scene import SceneBatch
    from scene_envs.scene_types import SceneType, get_scene_type, list_scene_types, register_scene_type

__version__ = "0.1.0"

_LAZY = {
    "SceneEnvsError": "scene_envs.errors",
    "Normalizer": "scene_envs.normalizer",
    "SceneBatch": "scene_envs.scene",
    "SceneType": "scene_envs.scene_types",
    "get_scene_type": "scene_envs.scene_types",
    "list_scene_types": "scene_envs.scene_types",
    "register_scene_type": "scene_envs.scene_types",
}

__all__ = [
    "Normalizer",
    "SceneBatch",
    "SceneEnvsError",
    "SceneType",
    "__version__",
    "get_scene_type",
    "list_scene_types",
    "register_scene_type",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'scene_envs' has no attribute {name!r}")


register_envs()
