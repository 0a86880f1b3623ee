"""Packages that bring their own scene types and grammars, found by entry point."""

from __future__ import annotations

import logging
from functools import cache
from importlib.metadata import entry_points

ENTRY_POINT_GROUP = "scene_envs.scene_types"
"""Packages offer modules under this entry-point group; importing one registers its scene types and grammars."""

_LOGGER = logging.getLogger(__name__)


@cache
def load_plugins() -> None:
    """Import every module that an installed package offers; once per process, when a name is not found here.

    A plug-in that fails to import is reported in the log and does not keep others from working.
    """
    for point in entry_points(group=ENTRY_POINT_GROUP):
        try:
            point.load()
        except Exception as error:
            _LOGGER.warning(
                "the scene types of %r could not be loaded: %s: %s", point.value, type(error).__name__, error
            )
