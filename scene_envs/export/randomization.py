"""Masses, frictions and colours of exported objects, drawn from distributions (domain randomization)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from scene_envs.errors import InvalidInputError
from scene_envs.export.placed import PlacedScene

DISTRIBUTIONS = ("uniform", "normal", "lognormal", "triangular")
"""Of numpy's generator, with its arguments in its order."""
KEYS = ("mass", "friction", "color")
"""Factor of mass and inertia; coefficient of friction; factor of red, green and blue, cut to 0..1."""


def read_randomization(
    source: str | os.PathLike[str] | Mapping[str, Any], formats: Iterable[str] = ()
) -> dict[str, Any]:
    """Settings from a YAML file or a mapping: ``seed``, and for some of ``KEYS`` one distribution with its arguments;
    nothing for an empty source.

    Raises InvalidInputError for a file that cannot be read, for unknown keys and distributions, and for colours in one
    of ``formats`` that carries none.

    >>> read_randomization({"mass": {"uniform": [0.8, 1.2]}})
    {'seed': 0, 'mass': {'uniform': [0.8, 1.2]}}
    """
    try:
        if not source:
            return {}
        found = source if isinstance(source, Mapping) else yaml.safe_load(Path(source).read_text(encoding="utf-8"))
        settings: dict[str, Any] = json.loads(json.dumps({"seed": 0, **found}))  # as a manifest holds them
        np.random.default_rng(settings["seed"])
        for key in settings.keys() - {"seed"}:
            if key not in KEYS:
                raise ValueError(f"unknown key {key!r}")
            _draw(settings, key, 1, [])
    except (OSError, ValueError, TypeError, AttributeError, OverflowError, yaml.YAMLError) as error:
        raise InvalidInputError(
            f"randomization={str(source)[:200]!r}: {' '.join(str(error).split())}; write seed: 0 and some of "
            f"{', '.join(KEYS)} as mass: {{uniform: [0.8, 1.2]}}, with one of {', '.join(DISTRIBUTIONS)}"
        ) from error
    if "color" in settings and (plain := {*formats} - {"mjcf", "npz"}):
        raise InvalidInputError(f"only mjcf carries randomized colours: leave out color, or {', '.join(sorted(plain))}")
    return settings


def randomize(scene: PlacedScene, settings: Mapping[str, Any]) -> PlacedScene:
    """The scene with drawn values. They depend on the seed, the key and the poses of the scene, on no other scene.

    Raises InvalidInputError for a mass or a friction that is not positive.
    """
    poses = b"".join(item.matrix.tobytes() for item in scene.objects)
    numbers = np.frombuffer(hashlib.sha256(poses).digest(), dtype=np.uint32).tolist()
    rows = [dict[str, Any]() for _ in scene.objects]
    for key in settings.keys() - {"seed"}:
        for row, item, value in zip(rows, scene.objects, _draw(settings, key, len(rows), numbers), strict=True):
            if key == "color":
                row["color"] = tuple(value.clip(0.0, 1.0).tolist())
            elif not value[0] > 0:
                raise InvalidInputError(f"randomization: {key}={value[0]:g} was drawn; it must be above 0")
            else:
                row |= {"friction": float(value[0])} if key == "friction" else {}
                row |= {"mass": item.mass * value[0], "inertia": item.inertia * value[0]} if key == "mass" else {}
    return replace(scene, objects=tuple(replace(item, **row) for item, row in zip(scene.objects, rows, strict=True)))


def _draw(settings: Mapping[str, Any], key: str, count: int, numbers: list[int]) -> Any:
    """(count, 3) draws; each key has its own stream."""
    ((name, values),) = settings[key].items()
    rng = np.random.default_rng([settings["seed"], KEYS.index(key), *numbers])
    if name not in DISTRIBUTIONS:
        raise ValueError(f"{key}: unknown distribution {name!r}")
    return getattr(rng, name)(*values, size=(count, 3))
