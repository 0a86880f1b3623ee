"""Keys of a command: their meaning from the docstrings, their values from words."""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, get_args, get_origin

from docstring_parser import DocstringStyle, parse

from agents.configuration.composition import (
    as_command_line_text,
    build,
    by_hydra,
    check_option,
    dotted_values,
    field_options,
    group_options,
    hint_of,
    layered,
    named_options,
    parse_config,
    verbatim,
    with_implied,
)
from agents.configuration.prior_names import adapted_name
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name


def attribute_meanings(cls: type) -> dict[str, str]:
    """Field name to sentence, from ``Attributes:`` in the Google-style docstrings of a class and its base classes.

    >>> class Size:
    ...     '''Extent.
    ...
    ...     Attributes:
    ...         height: extent along z, in
    ...             ``metres``.
    ...     '''
    >>> attribute_meanings(Size)
    {'height': 'extent along z, in metres.'}
    """
    meanings: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        for entry in parse(inspect.cleandoc(base.__doc__ or ""), style=DocstringStyle.GOOGLE).params:
            if entry.args[0] == "attribute":
                meanings[entry.arg_name] = " ".join((entry.description or "").replace("``", "").split())
    return meanings


_FIRST = ("scene", "prior", "scenes", "data", "reward", "objective", "count")
"""Keys that a listing starts with, in this order."""
_OPENING = "[{('\""
"""First characters of values that are no list without brackets."""


class KeyHelp(NamedTuple):
    """One key of a command."""

    name: str  # the text before ``=``; a key of a group begins with the name of the group and a dot
    default: str  # as it would be typed
    meaning: str  # one sentence


_ADAPTER = KeyHelp(
    "adapter",
    "",
    "updates of the prior: a prior that was trained from it, or the folder of such a run; A+0.5*B adds two.",
)
"""The key that every command with ``prior=`` has besides its own."""


def keys_of(command: Any) -> type:
    """The dataclass of a command's keys, which is the annotation of the argument ``settings`` of its ``run``."""
    annotation = command.run.__annotations__["settings"]
    return command.run.__globals__[annotation] if isinstance(annotation, str) else annotation


def describe_fields(config: type | Any) -> list[KeyHelp]:
    """The keys of a config (the default one, if its class is given), part by part; the keys of groups come last.

    Meanings stand under ``Attributes:`` in the docstrings.
    """
    return [key for _, keys in _sections(config) for key in keys]


def help_text(config: type | Any, words: Sequence[str] = (), config_dir: str = "") -> str:
    """All keys with their values and meanings, a paragraph for each part and for each group with its options; the
    headings name those that ``words`` choose.
    """
    chosen = dict(word.partition("=")[::2] for word in words)
    sections = _sections(config)
    has_parts = sum(isinstance(owner, type) for owner, _ in sections) > 1
    paragraphs = []
    for owner, keys in sections:
        if not isinstance(owner, type):
            name = getattr(getattr(config, owner.name, None), "name", "")
            heading = _heading(owner, chosen.get(owner.name, name), config_dir)
        else:
            heading = inspect.cleandoc(owner.__doc__ or "").partition("\n")[0].rstrip(".") + ":" if has_parts else ""
            after = next((place for place, key in enumerate(keys, 1) if key.name == "prior"), 0)
            keys[after:after] = [_ADAPTER] if after else []
        rows = format_rows([(f"{key.name}={key.default}", key.meaning) for key in keys])
        paragraphs.append(f"{heading}\n{rows}" if heading else rows)
    return "\n\n".join(paragraphs) or "  no keys"


def _sections(config: type | Any) -> list[tuple[type | dataclasses.Field[Any], list[KeyHelp]]]:
    """The keys that are no groups by the class that declares them, then those of each group by its field."""
    made = config() if isinstance(config, type) else config
    kinds, fields = type(made).__mro__, dataclasses.fields(made)
    first = {name: part for part in kinds for name in inspect.get_annotations(part)}  # declares the key first
    own = [(part, [field for field in fields if first[field.name] is part]) for part in kinds]
    parts = [(part, sorted(_keys(made, declared), key=_place)) for part, declared in own]
    groups = [(field, getattr(made, field.name)) for field in fields]
    return [
        *sorted(((part, keys) for part, keys in parts if keys), key=lambda section: _place(section[1][0])),
        *(
            (field, _keys(group, dataclasses.fields(group), f"{field.name}."))
            for field, group in groups
            if dataclasses.is_dataclass(group) and not field.metadata.get("one_key")
        ),
    ]


def _keys(made: Any, fields: Sequence[dataclasses.Field[Any]], prefix: str = "") -> list[KeyHelp]:
    """The keys among ``fields``; a mapping or a group inside a group is one, and the name of a component is none."""
    meanings, keys = attribute_meanings(type(made)), []
    for field in fields:
        value, meaning = getattr(made, field.name), meanings.get(field.name, "")
        if dataclasses.is_dataclass(value) and (prefix or field.metadata.get("one_key")):
            inner = attribute_meanings(type(value))
            meaning = " ".join([f"a mapping: {meaning}", *(f"{name}: {text}" for name, text in inner.items())])
        elif dataclasses.is_dataclass(value) or (prefix and field.name == "name"):
            continue
        keys.append(KeyHelp(prefix + field.name, as_command_line_text(value), meaning))
    return keys


def _place(key: KeyHelp) -> int:
    return _FIRST.index(key.name) if key.name in _FIRST else len(_FIRST)


def _heading(field: dataclasses.Field[Any], chosen: str, config_dir: str) -> str:
    if not field.metadata.get("folder"):
        return f"{field.name}:"
    option = chosen or field.metadata["option"]
    others = [other for other in field_options(field, config_dir) if other != option]
    return f"{field.name}={option}" + (f" (or {', '.join(others)}):" if others else ":")


def format_rows(rows: Sequence[tuple[str, str]]) -> str:
    """Two columns, the second wrapped to the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    formatter = argparse.HelpFormatter("", max_help_position=38, width=width)
    formatter.start_section(None)
    formatter.add_arguments(
        argparse.Action([], name, metavar=name, help=meaning.replace("%", "%%")) for name, meaning in rows
    )
    formatter.end_section()
    return formatter.format_help().rstrip()


def compose(command: str, config: type, words: Sequence[str], config_dir: str = "", config_file: str = "") -> Any:
    """An instance of ``config`` from ``key=value`` words, options of groups and ``+experiment=NAME``.

    Values are written as in Hydra: numbers, ``true``, ``null``, ``[1, 2]``, ``{name: clip, high: 20}``, ``${seed}``;
    the brackets of a list may be left out. The value of a key that takes one text is that text as it stands.

    ``config_dir`` is a folder with further groups and experiments, and the values of ``config_file`` take the place of
    the defaults; empty for none.

    Raises:
        UnknownNameError: no such key or option; the nearest one is offered.
        InvalidInputError: a word is not ``key=value``, or the value is not of the key's type.
    """
    fields = {field.name: field for field in dataclasses.fields(config)}
    if config_dir and not Path(config_dir).is_dir():
        raise InvalidInputError(f"--config-dir {config_dir}: no such folder")
    tree = read_config(config_file) if config_file else {}
    tree.pop("output", None)  # a run that is started again has a folder of its own
    choices: dict[str, str] = named_options(tree, fields, config_dir)
    values: dict[str, Any] = {}
    adapter = ""
    for word in words:
        key, equals, value = word.partition("=")
        head = key.partition(".")[0]
        if not equals or not key:
            raise InvalidInputError(f"{command}: expected key=value, got {word!r}; --help lists the keys")
        if key == _ADAPTER.name and "prior" in fields:
            adapter = value
        elif key == "+experiment" or (key == "recipe" and key in fields):
            check_option(folder := key.removeprefix("+"), value, group_options(folder, config_dir))
            choices[key] = value
        elif head not in fields:
            others = [_ADAPTER.name] if "prior" in fields else []
            raise unknown_name(f"{command} key", key, [*others, *dotted_values(config())])
        elif _is_option(fields[head], key, value, config_dir):
            choices[key] = value
            values.pop(key, None)
        elif _is_text(hint := _hint(config, key), value):
            values[key] = None if value == "null" and NoneType in get_args(hint) else verbatim(value)
        else:
            values.pop(key, None)  # later words come later
            values[key] = _parsed(command, key, value)
            if fields[head].metadata.get("named") and key == head:
                choices.pop(key, None)
    if config_file and "recipe" in choices:
        raise InvalidInputError("recipe= and --config exclude each other: the file says everything already")
    replaced = {*choices, *(key for key in values if key in fields and fields[key].metadata.get("named"))}
    tree = verbatim({key: value for key, value in tree.items() if key not in replaced})
    made = by_hydra(command, config, choices, config_dir)
    made |= by_hydra(command, config, named_options(made, fields, config_dir), config_dir)
    for key, value in values.items():
        made = _with(made, key, value, config, tree)
    settings: Any = build(config, with_implied(config, layered(config, tree, made)), command=command)
    if not adapter:
        return settings
    if not settings.prior:
        raise InvalidInputError(f"{command}: adapter={adapter} needs prior=, the prior that the adapter was trained on")
    return dataclasses.replace(settings, prior=adapted_name(settings.prior, adapter.strip("[]").replace(",", "+")))


def read_config(path: str) -> dict[str, Any]:
    """The values of a ``config.yaml``; an InvalidInputError without the file, a CorruptFileError without a mapping."""
    try:
        return parse_config(Path(path).read_text(encoding="utf-8"), f"--config {path}")
    except OSError as error:
        raise InvalidInputError(f"--config {path}: {error.strerror}; name the config.yaml of a run") from None
    except UnicodeDecodeError as error:
        raise CorruptFileError(f"--config {path} is not YAML ({error})") from error


def _is_option(field: dataclasses.Field[Any], key: str, value: str, config_dir: str) -> bool:
    """Whether the word chooses an option; refuses a value that can be nothing else and is none."""
    if key != field.name or not field.metadata.get("folder") or value.startswith("{"):
        return False
    known = field_options(field, config_dir)
    if not field.metadata.get("named"):
        check_option(field.name, value, known)
    return value in known


def _hint(config: type, key: str) -> Any:
    """The type of a dotted key, Any where only the component knows it."""
    kind: Any = config
    for part in key.split("."):
        kind = hint_of(kind, part) if dataclasses.is_dataclass(kind) else Any
    return kind


def _is_text(hint: Any, value: str) -> bool:
    """Whether a value is one text, which needs no quotes."""
    options = (hint,) if get_origin(hint) in (list, dict) else get_args(hint) or (hint,)
    return str in options and not (value.startswith("[") and any(get_origin(option) is list for option in options))


def read_override(word: str) -> Any:
    """A word as Hydra's parser reads it; None for a text that is none of its values."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(word)
    except (HydraException, ValueError):
        return None


def _parsed(command: str, key: str, value: str) -> Any:
    """The value of a word, read by Hydra, but for numbers: its import takes as long as the rest of a listing."""
    if re.fullmatch(r"-?(0|[1-9]\d{0,17})(\.\d+)?", value):
        return float(value) if "." in value else int(value)
    from hydra.core.override_parser.types import Sweep

    text = f"[{value}]" if "," in value and value[:1] not in _OPENING else value  # a,b is a list; to Hydra, a sweep
    override = read_override(f"{key}={text}")
    found = None if override is None else override.value()
    if override is None or any(isinstance(item, Sweep) for item in (found if isinstance(found, list) else [found])):
        raise InvalidInputError(f"{command}: a value cannot be read: {key}={value[:200]}")
    if isinstance(found, int) and abs(found) >= 2**63:
        raise InvalidInputError(f"{key}= has {len(str(abs(found)))} digits; whole numbers end at 2^63")
    return found


def _with(made: Mapping[str, Any], key: str, value: Any, config: type, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The values with one more, by dotted key."""
    head, *inner = key.split(".")
    if not inner and not dataclasses.is_dataclass(_hint(config, head)):
        return {**made, key: value}
    (field,) = (field for field in dataclasses.fields(config) if field.name == head)
    if field.metadata.get("named"):
        made = {head: tree.get(head, field.default), **made}
    for part in reversed([head, *inner]):
        value = {part: value}
    return layered(config, made, value)
