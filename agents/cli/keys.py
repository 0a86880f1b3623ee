"""Keys of a command: their meaning from the docstrings, their values from Hydra."""

from __future__ import annotations

import dataclasses
import inspect
import re
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from agents.configuration.compose import check_option, choice_word, compose_tree, group_options, hidden, shown
from agents.configuration.tree import build, check_not_moved, dotted_keys, parts_of, typed
from agents.utils.docstrings import attribute_meanings
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name

_FIRST = ("scene", "prior", "scenes", "data", "reward", "objective", "count")
"""Keys that a listing starts with, in this order."""
_OPENING = "[{('\""


@dataclass(frozen=True)
class KeyHelp:
    """One key of a command.

    Attributes:
        name: the text before ``=``; a key of a group begins with the name of the group and a dot.
        default: its default, as it would be typed.
        meaning: one sentence.
    """

    name: str
    default: str
    meaning: str


ADAPTER = KeyHelp(
    "adapter",
    "",
    "updates of the prior: a prior that was trained from it, or the folder of such a run; A+0.5*B adds two.",
)
"""The key that every command with ``prior=`` has besides its own."""


@dataclass(frozen=True)
class Sources:
    """Sources of a command's values, beside its words.

    Attributes:
        config_dir: a folder with further groups and experiments; empty for none.
        config: a ``config.yaml`` whose values take the place of the defaults; empty for none.
    """

    config_dir: str = ""
    config: str = ""


def keys_of(command: Any) -> type:
    """The dataclass of a command's keys, which is the annotation of the argument ``settings`` of its ``run``."""
    annotation = command.run.__annotations__["settings"]
    return command.run.__globals__[annotation] if isinstance(annotation, str) else annotation


def describe_fields(config: type | Any, prefix: str = "") -> list[KeyHelp]:
    """The keys of a config (the default one, if its class is given), part by part; the keys of groups come last.

    Meanings stand under ``Attributes:`` in the docstrings.
    """
    made = config() if isinstance(config, type) else config
    keys = _plain_keys(made, prefix) if prefix else [key for part in _parts(made).values() for key in part]
    for field, value in _groups(made):
        keys += describe_fields(value, f"{prefix}{field.name}.")
    return keys


def _groups(made: Any) -> list[tuple[dataclasses.Field[Any], Any]]:
    """The fields that are groups of keys, and their values."""
    values = [(field, getattr(made, field.name)) for field in dataclasses.fields(made)]
    return [(field, value) for field, value in values if dataclasses.is_dataclass(value)]


def _plain_keys(made: Any, prefix: str = "", fields: Sequence[dataclasses.Field[Any]] | None = None) -> list[KeyHelp]:
    """The keys among ``fields``, by default among all fields, that are no groups."""
    fields = dataclasses.fields(made) if fields is None else fields
    meanings, values = attribute_meanings(type(made)), {field.name: getattr(made, field.name) for field in fields}
    return [
        KeyHelp(prefix + name, typed(value), meanings.get(name, ""))
        for name, value in values.items()
        if not dataclasses.is_dataclass(value)
    ]


def _parts(made: Any) -> dict[type, list[KeyHelp]]:
    """The keys of a command that are no groups, by the class that declares them, in the order of a listing."""
    parts = {part: sorted(_plain_keys(made, fields=own), key=_place) for part, own in parts_of(type(made)).items()}
    return dict(sorted(((part, keys) for part, keys in parts.items() if keys), key=lambda item: _place(item[1][0])))


def _place(key: KeyHelp) -> int:
    return _FIRST.index(key.name) if key.name in _FIRST else len(_FIRST)


def help_text(config: type | Any, words: Sequence[str] = (), config_dir: str = "") -> str:
    """All keys with their values and meanings, a paragraph for each part and for each group with its options.

    Args:
        config: the config that ``words`` make, or its class.
        words: options of groups among them stand in the headings.
        config_dir: a folder with further options.
    """
    chosen = dict(word.partition("=")[::2] for word in words)
    made = config() if isinstance(config, type) else config
    sections = []
    parts = _parts(made)
    for part, keys in parts.items():
        after = next((place for place, key in enumerate(keys, 1) if key.name == "prior"), 0)
        keys[after:after] = [ADAPTER] if after else []
        title = inspect.cleandoc(part.__doc__ or "").partition("\n")[0].rstrip(".")
        sections.append(f"{title}:\n" * (len(parts) > 1) + _key_rows(keys))
    for field, group in _groups(made):
        known = getattr(field.default_factory, "KNOWN", ())
        sections.append(_heading(field, chosen.get(field.name, ""), known, config_dir))
        sections[-1] += f"\n{_key_rows(_plain_keys(group, f'{field.name}.'))}"
        for inner, value in _groups(group):
            name = f"{field.name}.{inner.name}"
            sections.append(f"{name}:\n{_key_rows(describe_fields(value, f'{name}.'))}")
    return "\n\n".join(sections) or "  no keys"


def _key_rows(keys: Sequence[KeyHelp]) -> str:
    return format_rows([(f"{key.name}={key.default}", key.meaning) for key in keys])


def _heading(field: dataclasses.Field[Any], chosen: str, known: Sequence[str], config_dir: str) -> str:
    folder = field.metadata.get("folder")
    if not folder:
        return f"{field.name}:"
    option = chosen or field.metadata["option"]
    offered = [other for other in group_options(folder, config_dir) if not known or other in known]
    others = [other for other in offered if other != option]
    return f"{field.name}={option}" + (f" (or {', '.join(others)}):" if others else ":")


def format_rows(rows: Sequence[tuple[str, str]]) -> str:
    """Two columns, the second wrapped to the terminal."""
    width = max(60, min(shutil.get_terminal_size().columns, 120))
    left = min(34, max(len(name) for name, _ in rows)) + 4
    lines = []
    for name, meaning in rows:
        wrapped = textwrap.wrap(meaning, width - left) or [""]
        head = f"  {name}"
        if len(head) > left - 2:
            lines.append(head)
            head = ""
        lines.append(head.ljust(left) + wrapped[0])
        lines.extend(" " * left + line for line in wrapped[1:])
    return "\n".join(line.rstrip() for line in lines)


def compose(command: str, config: type, words: Sequence[str], sources: Sources = Sources()) -> Any:
    """An instance of ``config`` from ``key=value`` words, options of groups and ``+experiment=NAME``.

    Values are written as in Hydra: numbers, ``true``, ``null``, ``[1, 2]``, ``{name: clip, high: 20}``; the brackets of
    a list may be left out.

    Raises:
        UnknownNameError: no such key or option; the nearest one is offered.
        InvalidInputError: a word is not ``key=value``, or the value is not of the key's type.
    """
    fields = {field.name: field for field in dataclasses.fields(config)}
    base = read_config(sources.config) if sources.config else None
    if base is not None:
        base.pop("output", None)  # a run that is started again has a folder of its own
    late: dict[str, Any] = {}
    read = []
    adapter = ""
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key:
            raise InvalidInputError(f"{command}: expected key=value, got {word!r}; --help lists the keys")
        if key.startswith("+experiment"):
            check_option("experiment", value, sources.config_dir)
            read.append(word)
            continue
        if key == ADAPTER.name and "prior" in fields and not value.startswith("{"):
            adapter = value
            continue
        key = getattr(config, "SHORT", {}).get(key, key)
        word = f"{key}={value}"
        check_not_moved(config, word, command)
        head = key.partition(".")[0]
        if head not in fields or head != key:
            check_not_moved(config, key, command)
        if head not in fields:
            raise unknown_name(f"{command} key", key, dotted_keys(config()))
        if key == head and fields[key].metadata.get("folder"):
            read += _component(command, fields[key], value, sources.config_dir, late)
        elif key == "recipe":
            check_option("recipe", value, sources.config_dir)
            read.append(word)
        elif group_options(key, sources.config_dir):  # a plain key that is called like a group of other commands
            late[key] = _parsed(command, key, _override(word, _hint(config, key)).partition("=")[2])
        else:
            read.append(_override(word, _hint(config, key)))
    tree = compose_tree(command, config, read, base=base, config_dir=sources.config_dir)
    settings: Any = build(config, {**tree, **late}, command=command)
    return _with_adapter(command, settings, adapter) if adapter else settings


def _with_adapter(command: str, settings: Any, adapter: str) -> Any:
    """Settings whose ``prior`` also names its adapters, so that code that loads the prior by name loads them too."""
    from agents.configuration.prior_names import adapted_name

    if not settings.prior:
        raise InvalidInputError(f"{command}: adapter={adapter} needs prior=, the prior that the adapter was trained on")
    return dataclasses.replace(settings, prior=adapted_name(settings.prior, adapter.strip("[]").replace(",", "+")))


def read_config(path: str) -> dict[str, Any]:
    """The values of a ``config.yaml``.

    Raises:
        InvalidInputError: there is no such file.
        CorruptFileError: it holds no mapping.
    """
    import yaml

    try:
        found = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidInputError(f"--config {path}: {error.strerror}; name the config.yaml of a run") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"--config {path} is not YAML ({str(error).splitlines()[0]})") from error
    if not isinstance(found, dict):
        raise CorruptFileError(f"--config {path} holds no keys")
    return found


def _component(
    command: str, field: dataclasses.Field[Any], value: str, config_dir: str, late: dict[str, Any]
) -> list[str]:
    """The word that chooses a component; a value that is no name goes into ``late`` instead."""
    name = field.name
    if value in group_options(field.metadata["folder"], config_dir):
        return [f"{name}={value}"]
    if field.metadata.get("named"):
        if value.isidentifier() and value not in ("null", "true", "false"):
            return [f"{name}={{name: {value}}}"]
        if not value.startswith("{"):
            late[name] = _parsed(command, name, value)
            return []
        _parsed(command, name, value)
    elif not value.startswith("{"):
        return [choice_word(field, value, config_dir)]
    return [f"{name}={value}"]


def _parsed(command: str, key: str, value: str) -> Any:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if "," in value and value[:1] not in _OPENING:
        value = f"[{value}]"  # a,b is a list, where Hydra would see a sweep
    try:
        found = OverridesParser.create().parse_override(hidden(f"{key}={value}")).value()
        return shown(OmegaConf.to_container(OmegaConf.create({"value": found}))["value"])  # type: ignore[index, call-overload]
    except (HydraException, OmegaConfBaseException, ValueError):
        raise InvalidInputError(f"{command}: a value cannot be read: {key}={value[:200]}") from None


def _hint(config: type, key: str) -> Any:
    """The type of a dotted key, Any where only the component knows it."""
    kind: Any = config
    for part in key.split("."):
        if not dataclasses.is_dataclass(kind) or part not in (hints := get_type_hints(kind)):
            return Any
        kind = hints[part]
    return kind


def _override(word: str, hint: Any) -> str:
    """The word as Hydra reads it, text quoted so that any character may stand in it."""
    key, _, value = word.partition("=")
    options = (hint,) if get_origin(hint) in (list, dict) else get_args(hint) or (hint,)
    is_list = any(get_origin(option) is list for option in options) and value.startswith("[")
    if str in options and not is_list and not (type(None) in options and value == "null"):
        value = _quoted(value)
    elif is_list and str in options:
        value = _text_list(word, value)
    elif "," in value and value[0] not in _OPENING:
        value = f"[{value}]"  # a,b is a list, where Hydra would see a sweep
    return f"{key}={value}"


def _text_list(word: str, value: str) -> str:
    """A list of texts in YAML as Hydra reads it."""
    import yaml

    try:
        texts = yaml.safe_load(value)
    except yaml.YAMLError:
        texts = None
    if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
        raise InvalidInputError(
            f'{word} is no list of texts; write \'["A scene with two cups.", "A scene with 9 objects."]\''
        )
    return f"[{','.join(map(_quoted, texts))}]"


def _quoted(text: str) -> str:
    """``text`` in Hydra's quotes, where backslashes count only before a quote."""
    return "'" + re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + ("\\'" if found[2] else ""), text) + "'"
