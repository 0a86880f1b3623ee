"""The denoising and search environments, their adapters, and the masks of the search.

``gym.make("scene_envs:SceneEnvs/Denoising-v0")`` and ``…/Search-v0`` need no import from here.
"""

from typing import TYPE_CHECKING

from scene_envs.lazy import lazy_names

if TYPE_CHECKING:
    from scene_envs.envs.denoising import DenoisingCore
    from scene_envs.envs.denoising_gymnasium import DenoisingEnv
    from scene_envs.envs.denoising_torchrl import DenoisingTorchRLEnv
    from scene_envs.envs.denoising_vector import DenoisingVectorEnv
    from scene_envs.envs.errors import ResetNeededError
    from scene_envs.envs.masks import list_masks, register_mask
    from scene_envs.envs.search import SearchProblem, SearchState
    from scene_envs.envs.search_gymnasium import SearchEnv
    from scene_envs.envs.trajectories import Trajectories

__all__ = [
    "DenoisingCore",
    "DenoisingEnv",
    "DenoisingTorchRLEnv",
    "DenoisingVectorEnv",
    "ResetNeededError",
    "SearchEnv",
    "SearchProblem",
    "SearchState",
    "Trajectories",
    "list_masks",
    "register_mask",
]

__getattr__ = lazy_names(
    __name__,
    {
        "DenoisingCore": "scene_envs.envs.denoising",
        "DenoisingEnv": "scene_envs.envs.denoising_gymnasium",
        "DenoisingTorchRLEnv": "scene_envs.envs.denoising_torchrl",
        "DenoisingVectorEnv": "scene_envs.envs.denoising_vector",
        "ResetNeededError": "scene_envs.envs.errors",
        "SearchEnv": "scene_envs.envs.search_gymnasium",
        "SearchProblem": "scene_envs.envs.search",
        "SearchState": "scene_envs.envs.search",
        "Trajectories": "scene_envs.envs.trajectories",
        "list_masks": "scene_envs.envs.masks",
        "register_mask": "scene_envs.envs.masks",
    },
)
