"""Masses, frictions and looks of exported scenes, drawn from distributions (domain randomization)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from scene_envs.errors import InvalidInputError
from scene_envs.export.placed import TEXTURES, PlacedScene
from scene_envs.files import read_yaml
from scene_envs.render.raster import Pinhole

DISTRIBUTIONS = {"uniform": 2, "normal": 2, "lognormal": 2, "triangular": 3}
"""Of numpy's generator, with the number of its arguments; a texture has ``choice`` and the names to choose from."""
KEYS = {
    "mass": "factor of mass and inertia; masses are in kg",
    "friction": "coefficient of friction",
    "color": "factor of red, green and blue, cut to 0..1",
    "texture": f"one of {', '.join(TEXTURES)}",
    "light_direction": "added to the unit vector (x, y, z) in which the lamp shines, world frame",
    "light_intensity": "factor of the lamp's brightness in the format",
    "light_color": "red, green and blue, cut to 0..1",
    "camera_position": "added to x, y and z, m, world frame",
    "camera_target": "added to x, y and z of the point that it looks at, m, world frame",
    "camera_fov_y": "added to the vertical field of view, degrees",
}
"""What is drawn, with its unit: the first four for each object, the others for each scene. Streams of random numbers go
by this order.
"""
PHYSICS = frozenset({"mass", "friction"})
_NAMES = tuple(KEYS)
_VECTORS = ("color", "light_direction", "light_color", "camera_position", "camera_target")
_HELD = {"npz": (), "glb": _NAMES[2:4], "urdf": _NAMES[:4], "drake": _NAMES[:4], "sdf": _NAMES[:7]}
"""Keys that a format holds, where these are not all."""


def read_randomization(source: str | os.PathLike[str] | Mapping[str, Any]) -> dict[str, Any]:
    """Settings from a YAML file or a mapping: ``seed``, and for some of ``KEYS`` one distribution with its arguments;
    nothing for an empty source.

    Raises InvalidInputError for a file that cannot be read or holds no mapping, for unknown keys, distributions and
    textures, and for other arguments.

    >>> read_randomization({"mass": {"uniform": [0.8, 1.2]}})
    {'seed': 0, 'mass': {'uniform': [0.8, 1.2]}}
    """
    place = ""
    try:
        if not source:
            return {}
        found = source if isinstance(source, Mapping) else read_yaml(Path(source))
        if not isinstance(found, Mapping):
            raise ValueError("it is empty" if found is None else f"it holds {found!r}, not keys with distributions")
        settings: dict[str, Any] = json.loads(json.dumps({"seed": 0, **found}))  # as a manifest holds them
        seed = settings["seed"]
        if type(seed) is not int or seed < 0:
            raise ValueError(f"seed={seed!r} must be a non-negative whole number")
        for key in settings.keys() - {"seed"}:
            if key not in KEYS:
                raise ValueError(f"unknown key {key!r}")
            place = f"{key}: "
            _check(settings[key], ("choice",) if key == "texture" else DISTRIBUTIONS)
            _draw(settings, key, 1, [])
    except (OSError, ValueError, TypeError, OverflowError, yaml.YAMLError) as error:
        raise InvalidInputError(
            f"randomization={str(source)[:200]!r}: {place}{' '.join(str(error).split())}; write seed: 0 and some of "
            f"{', '.join(KEYS)} as mass: {{uniform: [0.8, 1.2]}}, with one of {', '.join(DISTRIBUTIONS)}, or as "
            f"texture: {{choice: [{', '.join(TEXTURES)}]}}"
        ) from error
    return settings


def randomize(scene: PlacedScene, settings: Mapping[str, Any], repeat: int = 0) -> PlacedScene:
    """The scene with drawn values. They depend on the seed, the key, the poses of the scene, and on how many scenes of
    these poses come before it (``repeat``); on no other scene.

    Raises InvalidInputError for a mass, friction or intensity that is not positive, and for a camera that cannot be.
    """
    numbers = np.frombuffer(scene.digest, dtype=np.uint32).tolist() + [repeat] * (repeat > 0)
    count = len(scene.objects)
    draws = {key: _draw(settings, key, 1 if "_" in key else count, numbers) for key in settings.keys() - {"seed"}}
    for key in draws.keys() & {*PHYSICS, "light_intensity"}:
        if not (draws[key] > 0).all():
            raise InvalidInputError(f"randomization: {key}={draws[key].min():g} was drawn; it must be above 0")
    objects = []
    for index, item in enumerate(scene.objects):
        own: dict[str, Any] = {key: values[index] for key, values in draws.items() if "_" not in key}
        factor = own.pop("mass", 1.0)
        own |= {"color": _color(own["color"])} if "color" in own else {}
        objects.append(replace(item, mass=item.mass * factor, inertia=item.inertia * factor, **own))
    light: dict[str, Any] = {key[6:]: values[0] for key, values in draws.items() if key.startswith("light")}
    camera: dict[str, Any] = {key[7:]: values[0] for key, values in draws.items() if key.startswith("camera")}
    if "direction" in light:
        light["direction"] = tuple((scene.light.direction + light["direction"]).tolist())
    if "color" in light:
        light["color"] = _color(light["color"])
    for field, value in camera.items():
        moved = np.add(getattr(scene.camera, field), value)
        camera[field] = tuple(moved.tolist()) if moved.ndim else float(moved)
    view = replace(scene.camera, **camera)
    if camera:
        Pinhole.at(view.position, view.target, view.up, view.fov_y, view.width, view.height)
    lamp = replace(scene.light, **light) if light else scene.light
    return replace(scene, objects=tuple(objects), light=lamp, own_camera=view)


def record(scene: PlacedScene, settings: Mapping[str, Any], formats: Iterable[str]) -> dict[str, Any]:
    """What ``randomization.json`` says of a scene: settings with units, what each format leaves out, and all values."""
    drawn = [key for key in KEYS if key in settings]
    values = {x.name: {key: getattr(x, key) for key in _NAMES[:4]} for x in scene.objects}
    lost = {name: [key for key in drawn if key not in _HELD.get(name, KEYS)] for name in formats}
    return {
        **settings,
        "units": {key: KEYS[key] for key in drawn},
        "left_out": {name: keys for name, keys in lost.items() if keys},
        "verdict": "nominal",
        "light": asdict(scene.light),
        "camera": asdict(scene.camera),
        "objects": values,
    }


def _color(values: Any) -> tuple[float, ...]:
    return tuple(np.clip(values, 0.0, 1.0).tolist())


def _check(given: Any, known: Iterable[str]) -> None:
    """Raise ValueError for what is not one of the known distributions with its arguments."""
    pairs = [*given.items()] if isinstance(given, dict) else []
    if len(pairs) != 1 or not isinstance(pairs[0][1], list):
        raise ValueError(f"{given!r} is not one distribution with the list of its arguments")
    ((name, values),) = pairs
    if name not in known:
        raise ValueError(f"unknown distribution {name!r}")
    if name == "choice":
        if strange := {*map(str, values)} - {*TEXTURES}:
            raise ValueError(f"unknown {', '.join(sorted(strange))}")
    elif [type(value) in (int, float) for value in values] != [True] * DISTRIBUTIONS[name]:
        raise ValueError(f"{name} takes {DISTRIBUTIONS[name]} numbers, got {values}")


def _draw(settings: Mapping[str, Any], key: str, count: int, numbers: list[int]) -> Any:
    """(count, 3) draws, or (count,) lists of one each; each key has its own stream."""
    ((name, values),) = settings[key].items()
    rng = np.random.default_rng([settings["seed"], _NAMES.index(key), *numbers])
    drawn = rng.choice(values, size=(count, 3)) if key == "texture" else getattr(rng, name)(*values, size=(count, 3))
    if key != "texture" and not np.isfinite(drawn).all():
        raise InvalidInputError(f"randomization: {key}: {name}: {values} draws numbers that are not finite")
    return drawn if key in _VECTORS else drawn[:, 0].astype(object)
