"""Dataclasses from nested mappings and back: unknown keys and wrong types are refused with the key and the fix."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import types
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from scene_envs.errors import InvalidInputError, unknown_name

Config = TypeVar("Config")

_WANTED: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def build(kind: type[Config], tree: Mapping[str, Any], path: str = "", command: str = "") -> Config:
    """An instance of the dataclass ``kind`` from a nested mapping; missing keys keep their defaults.

    Args:
        kind: a dataclass, whose groups are dataclasses as well.
        tree: values by field name.
        path: where ``tree`` stands, for messages, such as ``"optimizer."``.
        command: whose keys these are, for messages.

    Raises:
        UnknownNameError: a key that ``kind`` does not have; the nearest one is offered.
        InvalidInputError: a value is not of the type of its key.
    """
    values = field_values(kind, tree, path, command)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.init and field.name not in values:
            values[field.name] = default_of(field)
    return kind(**values)


def field_values(kind: type, tree: Mapping[str, Any], path: str = "", command: str = "") -> dict[str, Any]:
    """The values of ``tree``, converted to the types of the fields of ``kind``."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    hints = get_type_hints(kind)
    values = {}
    for key, value in tree.items():
        if key not in fields:
            check_not_moved(kind, str(key), command)
            known = [path + name for name in fields]
            raise unknown_name(f"{command} key".strip(), path + str(key), known)
        values[key] = convert(fields[key], hints[key], value, path + key, command)
    return values


def convert(field: dataclasses.Field[Any], hint: Any, value: Any, path: str, command: str = "") -> Any:
    """``value``, converted for a field of type ``hint``."""
    if field.metadata.get("named"):
        if isinstance(value, int | float):
            raise InvalidInputError(f"{path}={typed(value)[:60]} is neither a name nor a mapping with a name")
        alone = isinstance(value, Mapping) and set(value) == {"name"}
        return value["name"] if alone else _plain(value)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            return value
        if not isinstance(value, Mapping):
            keys = ", ".join(f"{path}.{inner.name}" for inner in dataclasses.fields(hint))
            raise InvalidInputError(f"{path}={typed(value)}: {path} is a group of keys; give one of {keys}")
        return build(kind_of(field, hint, value), value, f"{path}.", command)
    return _scalar(hint, value, path)


def kind_of(field: dataclasses.Field[Any], hint: type, value: Mapping[str, Any]) -> type:
    """The dataclass of a group's settings, which its ``name`` decides where components are registered."""
    find: Callable[[str], type] | None = field.metadata.get("kinds")
    if find is None:
        return hint
    return find(value["name"] if "name" in value else default_of(field).name)


def default_of(field: dataclasses.Field[Any]) -> Any:
    """The default of a field, a new one where there is a factory."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def parts_of(kind: type) -> dict[type, list[dataclasses.Field[Any]]]:
    """Fields of a dataclass by the class that declares them first, its own before those of the classes it extends.

    >>> @dataclasses.dataclass
    ... class Seeded:
    ...     seed: int = 0
    >>> @dataclasses.dataclass
    ... class Draw(Seeded):
    ...     count: int = 1
    >>> {part.__name__: [field.name for field in fields] for part, fields in parts_of(Draw).items()}
    {'Draw': ['count'], 'Seeded': ['seed']}
    """
    first = {name: part for part in kind.__mro__ for name in inspect.get_annotations(part)}
    parts: dict[type, list[dataclasses.Field[Any]]] = {part: [] for part in kind.__mro__}
    for field in dataclasses.fields(kind):
        parts[first[field.name]].append(field)
    return {part: fields for part, fields in parts.items() if fields}


def check_not_moved(kind: type, key: str, command: str = "") -> None:
    """Refuse a key of an earlier version and name the one that took its place.

    Raises:
        InvalidInputError: ``kind.RENAMED`` knows the key.
    """
    renamed: Mapping[str, str] = getattr(kind, "RENAMED", {})
    group, _, last = key.rpartition(".")
    now = renamed.get(last, "").partition(",")[0]
    old = last if group and now.startswith(f"{group}.") and now != key else key  # an earlier name, below its group
    if old in renamed:
        raise InvalidInputError(f"the {command} key {key!r} has another name now: {renamed[old]}".replace("  ", " "))


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """A copy of a config with some values changed, by dotted key.

    >>> from dataclasses import dataclass, field
    >>> @dataclass
    ... class Inner:
    ...     size: int = 1
    >>> @dataclass
    ... class Outer:
    ...     inner: Inner = field(default_factory=Inner)
    >>> changed(Outer(), {"inner.size": 3})
    Outer(inner=Inner(size=3))
    """
    groups: dict[str, dict[str, Any]] = {}
    values: dict[str, Any] = {}
    known = {field.name for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    for key, value in changes.items():
        head, dot, rest = key.partition(".")
        if head not in known:
            raise unknown_name("key", key, dotted_keys(config))
        if dot:
            groups.setdefault(head, {})[rest] = value
        else:
            values[head] = value
    nested = {name: changed(values.get(name, getattr(config, name)), inner) for name, inner in groups.items()}
    return dataclasses.replace(config, **{**values, **nested})  # type: ignore[type-var]


def dotted_keys(config: Any) -> list[str]:
    """All keys of a config; a key of a group stands behind the name of the group and a dot."""
    return list(dotted_values(config))


def dotted_values(config: Any) -> dict[str, Any]:
    """All values of a config by :func:`dotted_keys`."""
    values: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        inner = dotted_values(value) if dataclasses.is_dataclass(value) else None
        values |= {field.name: value} if inner is None else {f"{field.name}.{key}": item for key, item in inner.items()}
    return values


def dotted(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one flat mapping with dotted keys.

    >>> dotted({"optimizer": {"lr": 0.1}, "seed": 0})
    {'optimizer.lr': 0.1, 'seed': 0}
    """
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def plain_tree(config: Any) -> dict[str, Any]:
    """A config as nested mappings of numbers, strings and lists, its keys in the order of :func:`parts_of`."""
    tree = _plain(config)
    return {field.name: tree[field.name] for part in parts_of(type(config)).values() for field in part}


def config_text(values: Any) -> str:
    """All keys as the ``config.yaml`` that ``--config`` reads; of a config, or of a nested mapping."""
    import yaml

    return yaml.safe_dump(plain_tree(values) if dataclasses.is_dataclass(values) else _plain(values), sort_keys=False)


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _scalar(hint: Any, value: Any, path: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any:
        return _plain(value)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        options = [option for option in arguments if option is not type(None)]
        for option in sorted(options, key=lambda option: option is str):  # a list of texts before a text
            with contextlib.suppress(InvalidInputError):
                return _scalar(option, value, path)
        wanted = " or ".join(map(_wanted, options))
        raise InvalidInputError(f"{path}={typed(value)} is not {wanted}{' or null' * (type(None) in arguments)}")
    if origin in (list, tuple):
        if not isinstance(value, list | tuple):
            _refuse(hint, value, path)
        return origin(_scalar(arguments[0], item, path) for item in value) if arguments else origin(value)
    if origin is dict:
        return _plain(value) if isinstance(value, Mapping) else _refuse(hint, value, path)
    if hint is float and isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)  # YAML reads 1e-4 as a text
        except (ValueError, OverflowError):
            _refuse(hint, value, path)
    if hint is str and isinstance(value, int | float) and not isinstance(value, bool):
        return str(value)
    if hint is int and isinstance(value, int) and abs(value) >= 2**63:
        raise InvalidInputError(f"{path} is a number of {len(str(abs(value)))} digits; whole numbers end at 2^63")
    right = isinstance(value, hint) and (hint is bool or not isinstance(value, bool))
    return value if right else _refuse(hint, value, path)


def _refuse(hint: Any, value: Any, path: str) -> Any:
    raise InvalidInputError(f"{path}={typed(value)[:300]} is not {_wanted(hint)}")


def _wanted(hint: Any) -> str:
    if get_origin(hint) in (list, tuple):
        inner = {int: "whole numbers", float: "numbers", str: "texts"}.get((*get_args(hint), Any)[0], "values")
        return f"a list of {inner}"
    if get_origin(hint) is dict:
        return "a mapping, as {key: value}"
    return _WANTED.get(hint, str(hint))


def typed(value: Any) -> str:
    """A value as it would be typed on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return ",".join(map(typed, value))
    return str(value)
