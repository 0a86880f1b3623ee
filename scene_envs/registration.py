"""Gymnasium registration of the environment family."""

from __future__ import annotations

import gymnasium


def register_envs() -> None:
    """Register every SceneEnvs environment with Gymnasium (idempotent)."""
    if "SceneEnvs/Denoising-v0" in gymnasium.registry:
        return
    gymnasium.register(
        id="SceneEnvs/Denoising-v0",
        entry_point="scene_envs.envs.denoising_gymnasium:DenoisingEnv",
        vector_entry_point="scene_envs.envs.denoising_vector:DenoisingVectorEnv",
        disable_env_checker=True,
        order_enforce=True,
    )
    gymnasium.register(
        id="SceneEnvs/Search-v0",
        entry_point="scene_envs.envs.search_gymnasium:SearchEnv",
        disable_env_checker=True,
    )
    gymnasium.register(
        id="SceneEnvs/SearchMask-v0",
        entry_point="scene_envs.envs.search_masks_gymnasium:SearchMaskEnv",
        disable_env_checker=True,
    )
