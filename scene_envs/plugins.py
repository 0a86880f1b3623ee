"""Entry points: contents that installed packages add to the registries of SceneEnvs."""

from __future__ import annotations

import logging
import sys
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

_LOGGER = logging.getLogger(__name__)


def plugin_entry_points(group: str) -> dict[str, EntryPoint]:
    """The entry points of ``group`` by name, of all installed packages.

    Those that the ``pyproject.toml`` of a checkout declares come first: an editable install keeps the metadata of the
    day it was made, and a checkout on the path has none.
    """
    installed = {point.name: point for point in entry_points(group=group)}
    declared = _checkout_entry_points(Path(__file__).parents[1] / "pyproject.toml").get(group, {})
    return installed | {name: EntryPoint(name, value, group) for name, value in declared.items()}


@cache
def _checkout_entry_points(pyproject: Path) -> dict[str, dict[str, str]]:
    """The entry points of this project's own ``pyproject.toml``, by group; none where there is no such file."""
    if sys.version_info < (3, 11) or not pyproject.is_file():  # Python 3.10 has no TOML reader: metadata alone
        return {}
    import tomllib

    project = tomllib.loads(pyproject.read_text()).get("project", {})
    groups: dict[str, dict[str, str]] = project.get("entry-points", {})
    return groups if project.get("name") == "scene-envs" else {}


@cache
def load_plugins(group: str) -> None:
    """Import every module of ``group``, which registers what it brings; once per process, when a name is not found.

    A plug-in that fails to import is reported in the log and does not keep others from working.
    """
    for point in plugin_entry_points(group).values():
        try:
            point.load()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # a module may also call sys.exit
            _LOGGER.warning(
                "the plug-in %r (%s) could not be loaded: %s: %s", point.value, group, type(error).__name__, error
            )
