"""Fields of a config that name a component or hold a group of keys, and recipes in Python."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from agents.configuration.compose import choice_word, compose_tree
from agents.configuration.tree import check_not_moved, convert, default_of, field_values, plain_tree
from scene_envs.errors import unknown_name

Kind = TypeVar("Kind", bound=type)


def nested(
    make: Callable[[], Any],
    *,
    folder: str = "",
    option: str = "",
    kinds: Callable[[str], type] | None = None,
    registered: Callable[[], Sequence[str]] = tuple,
) -> Any:
    """A field that is a group of keys, a dataclass.

    Args:
        make: its default.
        folder: of ``configs`` with its options; none where there is nothing to choose.
        option: the option that is the default.
        kinds: the dataclass of the settings of a registered component, by name; None where all have the same keys.
        registered: names of components, which may be chosen without a file.
    """
    metadata = {"folder": folder, "option": option, "kinds": kinds, "registered": registered}
    return dataclasses.field(default_factory=make, metadata=metadata)


def named(default: Any, folder: str) -> Any:
    """A field that names a component, or is a mapping with its ``name`` and settings.

    Args:
        default: a name, or None.
        folder: of ``configs`` with its options.
    """
    return dataclasses.field(default=default, metadata={"folder": folder, "option": default or "", "named": True})


def moved(group: str, *keys: str, **renamed: str) -> dict[str, str]:
    """Keys of an earlier version and their names now, in a group.

    >>> moved("optimizer", "clip", learning_rate="lr")
    {'clip': 'optimizer.clip', 'learning_rate': 'optimizer.lr'}
    """
    return {**{key: f"{group}.{key}" for key in keys}, **{old: f"{group}.{new}" for old, new in renamed.items()}}


def composed(kind: Kind) -> Kind:
    """A config dataclass that is made in Python as on the command line.

    A group may be given as its dataclass, as a mapping of those of its keys that differ, or as the name of an option
    in ``configs``; ``recipe`` sets all values that are not given.
    """
    init = kind.__init__  # type: ignore[misc]
    signature = inspect.signature(init)
    fields = {field.name: field for field in dataclasses.fields(kind)}
    recipe = default_of(fields["recipe"]) if "recipe" in fields else None

    @functools.wraps(init)
    def __init__(self: Any, *arguments: Any, **keywords: Any) -> None:
        _place_short(kind, keywords)
        for key in keywords:
            if key not in fields:
                check_not_moved(kind, key)
                raise unknown_name(f"{kind.__name__} field", key, fields)
        given = dict(signature.bind(self, *arguments, **keywords).arguments)
        given.pop("self")
        init(self, **_complete(kind, given, fields, recipe))

    kind.__init__ = __init__  # type: ignore[misc]
    return kind


def _place_short(kind: type, keywords: dict[str, Any]) -> None:
    """Move keys that are written without their group into the group that ``kind.SHORT`` gives."""
    short: Mapping[str, str] = getattr(kind, "SHORT", {})
    for key in short.keys() & keywords.keys():
        name, _, inner = short[key].partition(".")
        group, value = keywords.get(name, {}), {inner: keywords.pop(key)}
        keywords[name] = {**group, **value} if isinstance(group, Mapping) else dataclasses.replace(group, **value)


def _complete(
    kind: type, given: Mapping[str, Any], fields: Mapping[str, dataclasses.Field[Any]], recipe: Any
) -> dict[str, Any]:
    """The values given in Python, over those of the recipe and of the named options."""
    options = {
        name: value
        for name, value in given.items()
        if isinstance(value, str) and fields[name].metadata.get("folder") and not fields[name].metadata.get("named")
    }
    words = [choice_word(fields[name], value) for name, value in options.items()]
    if given.get("recipe", recipe) != recipe and len(given) < len(fields):
        words.append(f"recipe={given['recipe']}")
    tree = compose_tree(kind.__name__, kind, words) if words else {}
    values = field_values(kind, {name: value for name, value in tree.items() if name not in given})
    for name, value in given.items():
        values[name] = _group(fields[name], name, {} if name in options else value, tree.get(name, {}))
    return values


def _group(field: dataclasses.Field[Any], name: str, value: Any, base: Mapping[str, Any]) -> Any:
    """A group given as a mapping becomes its dataclass; other values stay as they are."""
    if field.default_factory is dataclasses.MISSING or not dataclasses.is_dataclass(default := field.default_factory()):
        return value
    tree = value
    if isinstance(value, Mapping):
        same = value.get("name", base.get("name")) in (None, getattr(default, "name", None))
        tree = {**(plain_tree(default) if same and not field.metadata.get("kinds") else {}), **base, **value}
    return convert(field, type(default), tree, name)
