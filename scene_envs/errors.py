"""Exceptions of SceneEnvs, whose messages name the value, the place and the remedy, and conditions on values."""

from __future__ import annotations

import difflib
import math
import operator
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_type_hints

MAX_NUMBER = 1e30


class SceneEnvsError(Exception):
    """Base of every error that SceneEnvs raises on purpose."""


class InvalidInputError(SceneEnvsError, ValueError):
    """A value given by the user is outside what the call accepts."""


class UnknownNameError(SceneEnvsError, KeyError):
    """No component has the given name."""

    def __str__(self) -> str:  # KeyError would print the repr of the message
        return str(self.args[0]) if self.args else ""


class CorruptFileError(SceneEnvsError):
    """A file exists, but it is damaged or not in the format that it should have."""


class MissingDependencyError(SceneEnvsError, ImportError):
    """An optional package is needed and is not installed."""


class PhysicsError(SceneEnvsError):
    """A physics computation could not be carried out."""


class RewardError(SceneEnvsError):
    """A reward broke its contract."""


class RewardTimeoutError(RewardError):
    """A reward exceeded its time limit."""


class TrainingError(SceneEnvsError):
    """A training run cannot continue; its progress so far is on disk."""


class StorageError(SceneEnvsError, OSError):
    """A file could not be written: the disk is full, or the folder may not be written to."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """The error for an unknown ``kind`` ("scene type", "reward", "prior") called ``name``. It offers the nearest of the
    ``known`` names, or the known dotted name whose last part ``name`` is.

    >>> str(unknown_name("reward", "object_cuont", ["object_count", "feasible_objects"]))
    "unknown reward 'object_cuont'; did you mean 'object_count'? Known: feasible_objects, object_count."
    """
    names = sorted(known)
    last = [known_name for known_name in names if known_name.rpartition(".")[2] == name]
    near = last or difflib.get_close_matches(name, names, n=1, cutoff=0.4)
    hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else "."
    return UnknownNameError(f"unknown {kind} {name!r}{hint} Known: {', '.join(names) or '(none)'}.")


def shown(value: Any) -> str:
    """A value in a message, of bounded length; Python refuses to write integers of thousands of digits."""
    return "a very large number" if isinstance(value, int) and abs(value) > MAX_NUMBER else repr(value)[:200]


@dataclass(frozen=True)
class Limit:
    """Condition on the value of a field; ``rule`` ends the message of the InvalidInputError. None is
    accepted where the field's type says so.
    """

    holds: Callable[[Any], bool]
    rule: str

    def check(self, place: str, name: str, value: Any, optional: bool) -> None:
        """Raise unless it holds for the field ``name``, where null is a choice if it is ``optional``."""
        with suppress(TypeError, ValueError, OverflowError):  # no number, an array, or a number of thousands of digits
            if (value is None and optional) or (not isinstance(value, bool) and self.holds(value)):
                return
        null = (
            " and finite" * (isinstance(value, float) and value == math.inf and "finite" not in self.rule)
            + ", or null" * optional
        )
        raise InvalidInputError(f"{place}{name}={shown(value)} {self.rule}{null}")


@dataclass(frozen=True)
class OneOf:
    """Condition that a field is one of the ``known`` words; the UnknownNameError calls it ``what`` or by its name."""

    known: tuple[str, ...]
    what: str = ""

    def check(self, place: str, name: str, value: Any, optional: bool) -> None:
        """Raise unless the word is known."""
        if value not in self.known:
            raise unknown_name(self.what or name, str(value), self.known)


def at_least(low: float) -> Limit:
    """Condition of a finite number of at least ``low``."""
    return Limit(lambda value: low <= value < math.inf, f"must be at least {low}")


FINITE = Limit(math.isfinite, "must be a finite number")
BELOW_ONE = Limit(lambda value: 0 <= value < 1, "must lie in [0, 1)")
Positive = Annotated[float, Limit(lambda value: math.isfinite(value) and value > 0, "must be a positive number")]
Nonnegative = Annotated[float, Limit(lambda value: value >= 0, "must be at least 0")]  # infinity is no limit
Unlimited = Annotated[float, Limit(lambda value: value > 0, "must be a positive number")]  # infinity is no limit
Count = Annotated[int, Limit(lambda value: operator.index(value) >= 1, "must be at least 1")]
Natural = Annotated[int, Limit(lambda value: operator.index(value) >= 0, "must be at least 0")]
Seed = Annotated[int, Limit(lambda seed: 0 <= seed < 2**63, "must be from 0 to 2^63 - 1")]
WORKERS = Limit(
    lambda workers: workers == "ray" or operator.index(workers) >= 0,
    "must be a number of processes, 0 for none, or ray for a Ray cluster",
)
Share = Annotated[float, Limit(lambda value: 0 <= value <= 1, "is outside 0..1: it is a share")]


class Checked:
    """Base of dataclasses with conditions in the annotations of their fields, as ``Count | None``, checked when made.

    >>> @dataclass
    ... class Cup(Checked):
    ...     sides: Count = 6
    >>> Cup(sides=0)
    Traceback (most recent call last):
    ...
    scene_envs.errors.InvalidInputError: sides=0 must be at least 1
    """

    place = ""
    """What stands in front of the name of a field in messages."""

    def __post_init__(self) -> None:
        for name, condition, optional in _conditions(type(self)):  # type: ignore[arg-type]
            condition.check(self.place, name, getattr(self, name), optional)


@cache
def _conditions(kind: type) -> list[tuple[str, Limit | OneOf, bool]]:
    """Name of the field, condition, and whether the field may be None."""
    try:
        hints = get_type_hints(kind, include_extras=True)
    except NameError as error:
        raise InvalidInputError(
            f"{kind.__qualname__}: the annotation of a field names {error.name!r}, which its module lacks when it runs;"
            " import it outside `if TYPE_CHECKING:`"
        ) from error
    parts = [(name, hint, part) for name, hint in hints.items() for part in (hint, *get_args(hint))]  # of a union, too
    return [
        (name, condition, type(None) in get_args(hint))
        for name, hint, part in parts
        for condition in getattr(part, "__metadata__", ())
        if isinstance(condition, Limit | OneOf)
    ]
