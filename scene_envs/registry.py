"""Registry of components by name: shipped ones, a user's, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import Any, TypeVar

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import load_plugins, plugin_entry_points

Component = TypeVar("Component")


class Registry(dict[str, Component]):
    """Components of one kind by name; the lookup of a missing name first loads the module that registers it.

    Args:
        kind: Kind of the components in messages, such as ``"planner"``.
        group: Group of entry points of installed packages.
        components: Components that are registered from the start.
        modules: Modules of this project, by name of the component that each registers when it is imported.
        read: Function from the entry point with the name of a component to that component; None where the entry points
            are modules that register components when they are imported.

    Raises:
        UnknownNameError: no component has the name of a lookup; the nearest known one is offered.

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
        """All names, those of installed packages included, sorted.

        Modules of this project are imported only where installed packages have modules that register components.
        """
        self._load_plugins()
        return sorted({*self, *self._modules, *(self.points() if self._read is not None else ())})

    def _load_plugins(self) -> None:
        """Import the modules of this project, then those of installed packages, which may replace its components."""
        if self._read is None and self.points():
            self._import(*self._modules.values())
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
