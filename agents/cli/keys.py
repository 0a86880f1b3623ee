"""Keys of a command: their meaning from the docstring, their values from Hydra."""

from __future__ import annotations

import dataclasses
import re
import shutil
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, get_type_hints

from agents.utils.docstrings import attribute_meanings
from scene_envs.errors import InvalidInputError, unknown_name

_FIRST = ("scene", "prior", "scenes", "data", "reward", "objective", "count", "output")
"""Keys that a listing starts with, in this order."""
_WANTED = {
    int: "a whole number",
    int | None: "a whole number or null",
    float: "a number",
    float | None: "a number or null",
    bool: "true or false",
}
_OPENING = "[{('\""


@dataclass(frozen=True)
class KeyHelp:
    """One key of a command.

    Attributes:
        name: what stands before ``=``.
        default: its default, as it would be typed.
        meaning: one sentence.
    """

    name: str
    default: str
    meaning: str


def describe_fields(config: type) -> list[KeyHelp]:
    """The keys of a config dataclass; meanings stand under ``Attributes:`` in its docstrings."""
    meanings = attribute_meanings(config)
    keys = [
        KeyHelp(field.name, _typed(_default(field)), meanings.get(field.name, ""))
        for field in dataclasses.fields(config)
    ]
    return sorted(keys, key=lambda key: _FIRST.index(key.name) if key.name in _FIRST else len(_FIRST))


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


def compose(command: str, config: type, words: Sequence[str]) -> Any:
    """An instance of ``config`` from ``key=value`` words over the packaged configuration of ``command``, if any.

    Values are written as in Hydra: numbers, ``true``, ``null``, ``[1, 2]``, ``{name: clip, high: 20}``; the brackets of
    a list may be left out.

    Raises:
        UnknownNameError: no such key; the nearest one is offered.
        InvalidInputError: a word is not ``key=value``, or the value is not of the key's type.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_module
    from hydra.core.config_store import ConfigStore
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    name = command.replace("-", "_")
    known = get_type_hints(config)
    hints = {field.name: known[field.name] for field in dataclasses.fields(config)}
    renamed: dict[str, str] = getattr(config, "RENAMED", {})
    overrides = [_override(command, word, hints, renamed) for word in words]
    keys = OmegaConf.structured(config)
    OmegaConf.set_readonly(keys, False)  # a frozen dataclass starts out read-only
    packaged = (resources.files("configs") / f"{name}.yaml").is_file()
    ConfigStore.instance().store(name=f"{name}_keys" if packaged else name, node=keys)
    try:
        with initialize_config_module("configs", version_base="1.3"):
            tree = hydra_compose(name, overrides=overrides)
        values = OmegaConf.to_container(tree, resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise InvalidInputError(f"{command}: {_plain_reason(error, words, hints)}") from error
    assert isinstance(values, dict)
    return config(**{str(key): value for key, value in values.items()})


def _override(command: str, word: str, hints: dict[str, Any], renamed: dict[str, str]) -> str:
    """The word as Hydra reads it, text quoted so that any character may stand in it."""
    key, equals, value = word.partition("=")
    if not equals or not key:
        raise InvalidInputError(f"{command}: expected key=value, got {word!r}; --help lists the keys")
    if key in renamed:
        raise InvalidInputError(f"the {command} key {key!r} has another name now: {renamed[key]}")
    if key not in hints:
        raise unknown_name(f"{command} key", key, hints)
    if hints[key] is str or (hints[key] == (str | None) and value != "null"):
        value = _quoted(value)
    elif "," in value and value[0] not in _OPENING:
        value = f"[{value}]"  # a,b is a list, where Hydra would see a sweep
    return f"{key}={value}"


def _quoted(text: str) -> str:
    """``text`` in Hydra's quotes, where backslashes count only before a quote."""
    return "'" + re.sub(r"(\\*)('|$)", lambda found: 2 * found[1] + ("\\'" if found[2] else ""), text) + "'"


def _plain_reason(error: BaseException, words: Sequence[str], hints: dict[str, Any]) -> str:
    """What the key wants, or the first line of the innermost explanation."""
    while error.__cause__ is not None:
        error = error.__cause__
    reason = str(error).splitlines()[0].strip().rstrip(".")
    typed = {word.partition("=")[0]: word for word in words}
    key = getattr(error, "full_key", None) or next((key for key, word in typed.items() if word in reason), "")
    if key not in typed:
        return f"{key}: {reason}" if key else f"a value cannot be read: {reason}"
    wanted = _WANTED.get(hints[key])
    return f"{typed[key]} is not {wanted}" if wanted else f"{typed[key]}: {reason}"


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def _typed(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return str(value)
