"""Checks of single values in a config, with messages that name the key."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from scene_envs.errors import InvalidInputError, unknown_name


def at_least(settings: Any, low: float, *names: str) -> None:
    """Refuse numbers below ``low``, and NaN; None stands for no number."""
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
    """Refuse a word that is not known, as ``what``; the nearest known one is offered."""
    if getattr(settings, name) not in known:
        raise unknown_name(what or name, str(getattr(settings, name)), known)
