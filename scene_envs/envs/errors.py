"""Errors of the environments: a missing reset, and a mask under the name of an earlier version."""

from __future__ import annotations

import gymnasium.error

from scene_envs.errors import InvalidInputError, SceneEnvsError

_RENAMED_MASKS = {"given": "explicit"}
"""Names of masks in earlier versions, and the present names."""


class ResetNeededError(SceneEnvsError, gymnasium.error.ResetNeeded):
    """``step`` was called before ``reset``, or after the end of an episode."""


def check_mask_not_renamed(name: str) -> None:
    """Refuse a mask name of an earlier version.

    Raises:
        InvalidInputError: the mask has another name now; the message says which.

    >>> check_mask_not_renamed("explicit")
    """
    if name in _RENAMED_MASKS:
        raise InvalidInputError(f"the mask {name!r} has another name now: {_RENAMED_MASKS[name]}")
