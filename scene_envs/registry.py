"""Registry of components by name: shipped ones, a user's, and those of installed packages."""

from __future__ import annotations

import ast
import hashlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NoReturn, TypeVar

import gymnasium

from scene_envs.errors import InvalidInputError, SceneEnvsError, unknown_name

_LOGGER = logging.getLogger(__name__)


def plugin_entry_points(group: str) -> dict[str, EntryPoint]:
    """The entry points of ``group`` by name, of all installed packages."""
    places = [(place, place or os.curdir) for place in sys.path]
    return _installed_entry_points(
        group, tuple((place, os.stat(path).st_mtime_ns) for place, path in places if os.path.exists(path))
    )


@cache
def _installed_entry_points(group: str, places: tuple[tuple[str, int], ...]) -> dict[str, EntryPoint]:
    """Read once, as the metadata of all packages are read for it, until a folder of the import path, whose times of
    change are in ``places``, is another or gets a package.
    """
    return {point.name: point for point in entry_points(group=group)}


@cache
def load_plugins(group: str) -> None:
    """Import every module of ``group``, which registers its components, and run the files of ``SCENE_ENVS_FILES``, once
    per process, when a name is not found. A plug-in that fails to import is reported in the log and does not keep
    others from working; a file that cannot be run is a PluginError.
    """
    for path in filter(None, os.environ.get(FILES, "").split(os.pathsep)):
        run_file(Path(path))
    for point in plugin_entry_points(group).values():
        try:
            load_plugin(point)
        except PluginError as error:
            _LOGGER.warning("the plug-in %r (%s) could not be loaded: %s", point.value, group, error)


def load_plugin(point: EntryPoint) -> Any:
    """Import the module of an entry point and return the object that it names; PluginError says why that failed.

    ``sys.exit`` and ``os._exit`` end the import and not the process. It may take ``SCENE_ENVS_PLUGIN_SECONDS`` (60 by
    default), but is not ended outside the main thread or in compiled code that holds the interpreter.
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
        raise PluginError(describe_error(error)) from error


class PluginError(SceneEnvsError):
    """A plug-in cannot be imported."""


FILES = "SCENE_ENVS_FILES"
"""Environment variable with files of the user, which register components as the modules of installed packages do; the
processes that a command starts inherit it."""


ALLOWED: set[Path] = set()
"""Files of the user that may run without a question."""


def run_file(path: Path) -> ModuleType:
    """The module of a Python file, which runs once per process; PluginError says why it cannot be run."""
    path = path.expanduser().resolve()
    name = f"scene_envs_file_{hashlib.blake2b(str(path).encode(), digest_size=8).hexdigest()}"
    if name not in sys.modules:
        spec = spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise PluginError(f"{str(path)!r} cannot be run: its name must end in .py")
        sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException as error:
            del sys.modules[name]
            if isinstance(error, KeyboardInterrupt):
                raise
            raise PluginError(f"{str(path)!r} cannot be run: {describe_error(error)[:300]}") from error
    return sys.modules[name]


_LATE = "the import of a plug-in takes too long"
_MAX_TEXT = 500
"""Number of characters of a foreign error that a message repeats."""


def describe_error(error: BaseException) -> str:
    """Type and text of an error of foreign code, of bounded length.

    >>> describe_error(ValueError("no")), len(describe_error(ValueError("x" * 10**6))) < 600
    ('ValueError: no', True)
    """
    text = error_text(error)
    name = type.__dict__["__name__"].__get__(type(error))  # a metaclass may override ``__name__``
    return f"{name}: {text}" if text else str(name)


def error_text(error: BaseException) -> str:
    """The text of an error of foreign code, of bounded length."""
    try:
        text = str(error)
    except BaseException:
        return "(its text cannot be read)"
    return text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}... ({len(text)} characters)"


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


Component = TypeVar("Component")


class Registry(dict[str, Component]):
    """Components of one kind by name; the lookup of a missing name first loads the module that registers it.

    ``kind`` names them in messages ("planner"), ``group`` is the group of entry points of installed packages, and
    ``modules`` are this project's, by name of the component that each registers at import. ``read`` makes a component
    of its entry point; it is None where entry points are modules that register components. Raises UnknownNameError.

    >>> teas = Registry("tea", "doctest.teas", {"green": 80})
    >>> teas["green"], teas.names()
    (80, ['green'])
    >>> teas["gren"]
    Traceback (most recent call last):
    ...
    scene_envs.errors.UnknownNameError: unknown tea 'gren'; did you mean 'green'? Known: green.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        components: Mapping[str, Component] | None = None,
        *,
        modules: Mapping[str, str] | None = None,
        read: Callable[[EntryPoint], Component] | None = None,
    ) -> None:
        super().__init__(components or {})
        self.kind, self.group, self._modules, self._read = kind, group, modules or {}, read

    def __getitem__(self, name: Any) -> Component:
        if not isinstance(name, str):
            raise InvalidInputError(f"{self.kind} {str(name)[:200]!r}: give a name; known: {', '.join(self.names())}")
        return super().__getitem__(name)

    def __missing__(self, name: Any) -> Component:
        self._load_plugins()
        if name not in self and name in self._modules:
            self._import(self._modules[name])
        if name not in self and self._read is not None and (point := self.points().get(name)) is not None:
            self.setdefault(name, self._read(point))
        if name not in self:
            raise unknown_name(self.kind, str(name), self.names())
        return self[name]

    def names(self) -> list[str]:
        """All names, those of installed packages included, sorted. Modules of this project are imported only where
        installed packages have modules that register components.
        """
        self._load_plugins()
        return sorted({*self, *self._modules, *(self.points() if self._read is not None else ())})

    def _load_plugins(self) -> None:
        """Import the modules of this project, then those of installed packages, which may replace its components."""
        if self._read is None:
            self._import(*(self._modules.values() if self.points() else ()))
            load_plugins(self.group)

    def _import(self, *modules: str) -> None:
        """Import modules of this project; they do not replace components that are already registered."""
        registered = dict(self)
        for module in modules:
            import_module(module)
        self.update(registered)

    def adding(self, name: str, entry: Callable[[Any], Component] | None = None) -> Callable[[Any], Any]:
        """A decorator that registers its argument, or the result of ``entry`` for it, as the component ``name``."""

        def add(made: Any) -> Any:
            self[name] = made if entry is None else entry(made)
            return made

        return add

    def points(self) -> dict[str, EntryPoint]:
        """The entry points of installed packages, by name."""
        return plugin_entry_points(self.group)

    def check_name(self, name: str, example: str) -> None:
        """Raise InvalidInputError unless ``name`` is one word."""
        if not name.isidentifier():
            form = f"use letters, digits and underscores, such as {example!r}"
            raise InvalidInputError(f"{self.kind} name {name!r}: {form}")


def lazy_names(package: str, file: str) -> Callable[[str], Any]:
    """A module's ``__getattr__`` (PEP 562), which imports the names that the module lists under ``if TYPE_CHECKING:``,
    the only list of names and of the modules that define them. ``package`` and ``file`` are ``__name__`` and
    ``__file__`` of the module, whose source is read at the first lookup.
    """

    @cache
    def homes() -> dict[str, str]:
        tree = ast.parse(Path(file).read_text(encoding="utf-8"))
        guarded = [node for guard in tree.body if isinstance(guard, ast.If) for node in guard.body]
        imports = [node for node in guarded if isinstance(node, ast.ImportFrom)]
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name.startswith("__") or name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes()[name]), name)

    return load


def register_envs() -> None:
    """Register every SceneEnvs environment with Gymnasium (idempotent)."""
    if "SceneEnvs/Denoising-v0" in gymnasium.registry:
        return
    adapters, search = "scene_envs.envs.denoising_adapters", "scene_envs.envs.search_gymnasium"
    gymnasium.register(
        "SceneEnvs/Denoising-v0",
        f"{adapters}:DenoisingEnv",
        vector_entry_point=f"{adapters}:DenoisingVectorEnv",
        disable_env_checker=True,
    )
    gymnasium.register("SceneEnvs/Search-v0", f"{search}:SearchEnv", disable_env_checker=True)
    gymnasium.register("SceneEnvs/SearchMask-v0", f"{search}:SearchMaskEnv", disable_env_checker=True)
