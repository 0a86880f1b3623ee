"""The denoising and search environments, their adapters, and the masks of the search.

``gym.make("scene_envs:SceneEnvs/Denoising-v0")``, ``…/Search-v0`` and ``…/SearchMask-v0`` need no import from here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from scene_envs.envs.denoising import DenoisingCore, StepResult
    from scene_envs.envs.denoising_adapters import DenoisingEnv, DenoisingTorchRLEnv, DenoisingVectorEnv
    from scene_envs.envs.masks import MaskGenerator, list_masks, register_mask
    from scene_envs.envs.scoring import Score
    from scene_envs.envs.search import SearchProblem, SearchState
    from scene_envs.envs.search_gymnasium import SearchEnv, SearchMaskEnv
    from scene_envs.envs.spaces import ResetNeededError

__all__ = [
    "DenoisingCore",
    "DenoisingEnv",
    "DenoisingTorchRLEnv",
    "DenoisingVectorEnv",
    "MaskGenerator",
    "ResetNeededError",
    "Score",
    "SearchEnv",
    "SearchMaskEnv",
    "SearchProblem",
    "SearchState",
    "StepResult",
    "list_masks",
    "register_mask",
]

__getattr__ = lazy_names(__name__, __file__)
