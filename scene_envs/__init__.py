"""SceneEnvs: Gymnasium environments for steering 3D scene generation.

Importing this package registers the environments and does nothing more; torch and PyBullet load when an
environment is built or when a public name is first used. The names below are about scenes and scene types; the packages
``assets``, ``datasets``, ``envs``, ``export``, ``grammars``, ``physics`` and ``render`` have the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names, register_envs

if TYPE_CHECKING:
    from scene_envs.envs import list_masks, register_mask
    from scene_envs.errors import InvalidInputError, SceneEnvsError, UnknownNameError
    from scene_envs.grammars import get_grammar
    from scene_envs.normalizer import Normalizer
    from scene_envs.scene import SceneBatch
    from scene_envs.scene_types import (
        Camera,
        FixedObject,
        SceneType,
        get_scene_type,
        list_scene_types,
        register_scene_type,
        union_scene_type,
    )

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "FixedObject",
    "InvalidInputError",
    "Normalizer",
    "SceneBatch",
    "SceneEnvsError",
    "SceneType",
    "UnknownNameError",
    "__version__",
    "get_grammar",
    "get_scene_type",
    "list_masks",
    "list_scene_types",
    "register_mask",
    "register_scene_type",
    "union_scene_type",
]

__getattr__ = lazy_names(__name__, __file__)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
