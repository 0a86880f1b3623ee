"""Registry of components by name: shipped ones, a user's, and those of installed packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import Any, TypeVar

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import load_plugins, plugin_entry_points

Component = TypeVar("Component")


class Registry(dict[str, Component]):
    """Components of one kind by name; a lookup of a name that is not there first loads what may bring it.

    Args:
        kind: what messages call a component, such as ``"planner"``.
        group: entry points of installed packages.
        components: those that are there from the start.
        modules: modules of this project that register components when they are imported.
        read: from an entry point, which is called like its component, to the component; None where the entry points are
            modules that register components when they are imported.

    Raises:
        UnknownNameError: at a lookup, when nothing has that name; the nearest known one is offered.

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
        modules: Sequence[str] = (),
        read: Callable[[EntryPoint], Component] | None = None,
    ) -> None:
        super().__init__(components or {})
        self.kind, self.group, self._modules, self._read = kind, group, modules, read

    def __missing__(self, name: Any) -> Component:
        self.load()
        if name not in self:
            point = None if self._read is None else self.points().get(name)
            if self._read is None or point is None:
                raise unknown_name(self.kind, str(name), self.names())
            self.setdefault(name, self._read(point))
        return self[name]

    def load(self) -> None:
        """Import the modules that register components; those of this project replace nothing."""
        registered = dict(self)
        for module in self._modules:
            import_module(module)
        self.update(registered)
        if self._read is None:
            load_plugins(self.group)

    def names(self) -> list[str]:
        """All names, those of installed packages included, sorted."""
        self.load()
        return sorted({*self, *(self.points() if self._read is not None else ())})

    def points(self) -> dict[str, EntryPoint]:
        """The entry points of installed packages, by name."""
        return plugin_entry_points(self.group)

    def check_name(self, name: str, example: str) -> None:
        """Raise InvalidInputError unless ``name`` is one word."""
        if not name.isidentifier():
            form = f"use letters, digits and underscores, such as {example!r}"
            raise InvalidInputError(f"{self.kind} name {name!r}: {form}")
