"""Exceptions of SceneEnvs; every message names the value, the place and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


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
