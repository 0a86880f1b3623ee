"""Errors of the environments."""

from __future__ import annotations

import gymnasium.error

from scene_envs.errors import SceneEnvsError


class ResetNeededError(SceneEnvsError, gymnasium.error.ResetNeeded):
    """``step`` was called before ``reset``, or after the end of an episode."""
