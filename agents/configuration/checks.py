"""Checks of single values in a config, with messages that name the key."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from scene_envs.errors import InvalidInputError, unknown_name


def at_least(settings: Any, low: float, *names: str) -> None:
    """Refuse numbers below ``low``, and NaN; None is accepted."""
    for name in names:
        if getattr(settings, name) is not None and not getattr(settings, name) >= low:
            raise InvalidInputError(f"{name}={getattr(settings, name)} must be at least {low}")


def positive(settings: Any, *names: str) -> None:
    """Refuse numbers that are not positive."""
    for name in names:
        if not getattr(settings, name) > 0:
            raise InvalidInputError(f"{name}={getattr(settings, name)} must be positive")


def finite(settings: Any, *names: str) -> None:
    """Refuse infinite numbers and NaN."""
    for name in names:
        if not math.isfinite(getattr(settings, name)):
            raise InvalidInputError(f"{name}={getattr(settings, name)} must be a finite number")


def shares(settings: Any, *names: str) -> None:
    """Refuse numbers outside 0 to 1."""
    for name in names:
        if not 0 <= getattr(settings, name) <= 1:
            raise InvalidInputError(f"{name}={getattr(settings, name)} is outside 0..1: it is a share")


def one_of(settings: Any, name: str, known: Sequence[str], what: str = "") -> None:
    """Refuse a word that is not in ``known``; the message calls it ``what`` and offers the nearest known word."""
    if getattr(settings, name) not in known:
        raise unknown_name(what or name, str(getattr(settings, name)), known)


def check_types(kind: type, values: Mapping[str, Any]) -> None:
    """Refuse values of the wrong type for the fields of a dataclass that are numbers, texts or booleans.

    Raises:
        InvalidInputError: a value of another type; names the field.

    >>> from dataclasses import make_dataclass
    >>> check_types(make_dataclass("Size", [("depth", int)]), {"depth": "deep"})
    Traceback (most recent call last):
    scene_envs.errors.InvalidInputError: depth='deep' must be of type int
    """
    for name, wanted in get_type_hints(kind).items():
        plain = set(get_args(wanted) if get_origin(wanted) in (Union, UnionType) else (wanted,))
        if name not in values or not plain <= {int, float, str, bool, NoneType}:
            continue
        value = values[name]
        fits = any(type(value) is one or (one is float and type(value) is int) for one in plain)
        if not fits or (isinstance(value, float) and not math.isfinite(value)):
            told = " or ".join(sorted("null" if one is NoneType else one.__name__ for one in plain))
            raise InvalidInputError(f"{name}={str(value)[:100]!r} must be of type {told}")
