"""Entry points, by which installed packages add components to the registries of SceneEnvs."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from scene_envs.errors import SceneEnvsError

_LOGGER = logging.getLogger(__name__)


def plugin_entry_points(group: str) -> dict[str, EntryPoint]:
    """The entry points of ``group`` by name, of all installed packages.

    Entry points that the ``pyproject.toml`` of a checkout declares replace installed ones of the same name. The
    metadata of an editable install may be out of date, and a checkout on the path has none.
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
    """Import every module of ``group``; each module registers its components when it is imported.

    This happens once per process, when a name is not found. A plug-in that fails to import is reported in the log
    and does not keep others from working.
    """
    for point in plugin_entry_points(group).values():
        try:
            load_plugin(point)
        except PluginError as error:
            _LOGGER.warning("the plug-in %r (%s) could not be loaded: %s", point.value, group, error)


def load_plugin(point: EntryPoint) -> Any:
    """Import the module of an entry point and return the object that the entry point names.

    ``sys.exit`` and ``os._exit`` at import end the import and not the process. An import that takes longer than
    ``SCENE_ENVS_PLUGIN_SECONDS`` (60 by default) is ended. An import outside the main thread is not ended, nor is
    compiled code that holds the interpreter.

    Raises:
        PluginError: the import failed; the message gives the reason.
    """
    seconds = _seconds()
    try:
        with _exits_as_errors(), _ended_after(seconds):
            return point.load()
    except KeyboardInterrupt as error:
        if error.args != (_LATE,):
            raise
        raise PluginError(f"its import took longer than {seconds:g} s; SCENE_ENVS_PLUGIN_SECONDS allows more") from None
    except SystemExit as error:
        raise PluginError(f"it calls sys.exit({str(error.code)[:80]}) when it is imported") from None
    except BaseException as error:
        raise PluginError(f"{type(error).__name__}: {_text(error)}") from error


class PluginError(SceneEnvsError):
    """A plug-in cannot be imported."""


_LATE = "the import of a plug-in takes too long"
_MAX_TEXT = 500


def _text(error: BaseException) -> str:
    try:
        text = str(error)
    except Exception:
        return "(its text cannot be read)"
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}..."


def _seconds() -> float:
    try:
        seconds = float(os.environ.get("SCENE_ENVS_PLUGIN_SECONDS", "60"))
    except ValueError:
        return 60.0
    return seconds if 0 < seconds < 1e6 else 60.0


@contextmanager
def _exits_as_errors() -> Iterator[None]:
    """Context in which ``os._exit`` of this process raises SystemExit."""
    leave, process = os._exit, os.getpid()

    def refuse(status: int) -> NoReturn:
        if os.getpid() != process:  # a process that the plug-in forked
            leave(status)
        raise SystemExit(status)

    os._exit = refuse  # type: ignore[assignment]
    try:
        yield
    finally:
        os._exit = leave


@contextmanager
def _ended_after(seconds: float) -> Iterator[None]:
    """Context that is interrupted after ``seconds``, unless the alarm is in use or this is not the main thread."""
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or not hasattr(signal, "setitimer") or signal.getitimer(signal.ITIMER_REAL)[0]:
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt(_LATE)  # not caught by code that catches every Exception

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL if before is None else before)
