"""SceneEnvs: Gymnasium environments for steering 3D scene generation.

Importing this package registers the environments and does nothing more; torch and PyBullet load when an
environment is built or when a public name is first used. The names below are those that most users need; the packages
``assets``, ``datasets``, ``envs``, ``export``, ``grammars``, ``physics`` and ``render`` have more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names, register_envs

if TYPE_CHECKING:
    from scene_envs.assets import list_assets, load_library
    from scene_envs.datasets import SceneDataset, describe, generate, parse_prompt
    from scene_envs.envs import (
        DenoisingEnv,
        DenoisingTorchRLEnv,
        DenoisingVectorEnv,
        SearchEnv,
        SearchMaskEnv,
        check_branchable,
        list_masks,
        register_mask,
    )
    from scene_envs.errors import InvalidInputError, SceneEnvsError, UnknownNameError
    from scene_envs.export import list_formats, register_format
    from scene_envs.grammars import Grammar, get_grammar, list_grammars, register_grammar
    from scene_envs.normalizer import Normalizer
    from scene_envs.physics import PhysicsPool, feasibility, make_ready, penetration, project, settle
    from scene_envs.render import write_viewer
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
    "DenoisingEnv",
    "DenoisingTorchRLEnv",
    "DenoisingVectorEnv",
    "FixedObject",
    "Grammar",
    "InvalidInputError",
    "Normalizer",
    "PhysicsPool",
    "SceneBatch",
    "SceneDataset",
    "SceneEnvsError",
    "SceneType",
    "SearchEnv",
    "SearchMaskEnv",
    "UnknownNameError",
    "__version__",
    "check_branchable",
    "describe",
    "feasibility",
    "generate",
    "get_grammar",
    "get_scene_type",
    "list_assets",
    "list_formats",
    "list_grammars",
    "list_masks",
    "list_scene_types",
    "load_library",
    "make_ready",
    "parse_prompt",
    "penetration",
    "project",
    "register_format",
    "register_grammar",
    "register_mask",
    "register_scene_type",
    "settle",
    "union_scene_type",
    "write_viewer",
]

__getattr__ = lazy_names(__name__, __file__)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
