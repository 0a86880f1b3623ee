"""Reader of ``library.yaml``, a user's settings for the files of a folder."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from scene_envs.assets.base import regular_plural
from scene_envs.assets.importing.decomposition import METHODS, Method
from scene_envs.assets.importing.mesh_files import MESH_SUFFIXES
from scene_envs.assets.importing.model import Color
from scene_envs.errors import CorruptFileError, InvalidInputError

YAML_NAMES = ("library.yaml", "library.yml")
SUFFIXES = (".urdf", ".sdf", *MESH_SUFFIXES)
"""Files that can become assets."""
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
AXES: tuple[Axis, ...] = ("x", "y", "z", "-x", "-y", "-z")
Base = Literal["bottom", "origin"]
BASES: tuple[Base, ...] = ("bottom", "origin")


@dataclass(frozen=True)
class AssetNames:
    """File and names of an asset.

    Attributes:
        file: Path relative to the folder.
        name: Identifier; the stem of the file by default.
        display_name: Name in prompts; the identifier with spaces by default.
        plural: Plural of the display name; the regular one by default.
    """

    file: str
    name: str = ""
    display_name: str = ""
    plural: str = ""


@dataclass(frozen=True)
class AssetEntry(AssetNames):
    """One asset of a library: its names and how its file becomes a body.

    Attributes:
        scale: Factor on all lengths; a file in millimetres needs 0.001.
        density: Density (kg/m^3) of the evenly filled shape.
        mass: Mass, kg.
        welded: Whether the asset is fixed to the world; the file decides by default.
        up: Axis of the file that points up.
        color: Class colour (r, g, b), also used for surfaces without a colour.
        base: ``"bottom"`` puts the frame under the middle of the bounding box, ``"origin"`` leaves it.
        decomposition: ``"auto"``, ``"coacd"`` or ``"convex"``; see :func:`convex_parts`.
        concavity: CoACD's threshold, 0.01 (many parts) to 1 (one).
    """

    scale: float = 1.0
    density: float | None = None
    mass: float | None = None
    welded: bool | None = None
    up: Axis = "z"
    color: Color | None = None
    base: Base = "bottom"
    decomposition: Method = "auto"
    concavity: float = 0.05


_TEXTS = ("file", "name", "display_name", "plural")
_NUMBERS = ("scale", "density", "mass", "concavity")
_CHOICES: Mapping[str, tuple[str, ...]] = {"up": AXES, "base": BASES, "decomposition": METHODS}


def read_entries(path: Path) -> list[AssetEntry]:
    """The entries of a YAML file: a list of mappings, one per asset.

    Raises:
        CorruptFileError: not YAML; the line is named.
        InvalidInputError: an unknown key (the nearest known one is offered), a value that cannot be, a file
            that does not exist, or a name that appears twice.
    """
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{path} is not well-formed YAML: {' '.join(str(error).split())}") from error
    except OSError as error:
        raise CorruptFileError(f"{path} cannot be read: {error.strerror or error}") from error
    if not isinstance(content, list) or not content:
        raise InvalidInputError(f"{path} must be a list of assets, each beginning with `- file: ...`")
    entries = [_entry(item, f"{path}, asset {index}", path.parent) for index, item in enumerate(content, start=1)]
    check_names(entries, str(path))
    return entries


def check_names(entries: list[AssetEntry], where: str) -> None:
    """Raise InvalidInputError when two entries have the same name."""
    files: dict[str, str] = {}
    for entry in entries:
        if entry.name in files:
            raise InvalidInputError(
                f"{where}: {files[entry.name]!r} and {entry.file!r} are both called {entry.name!r}; "
                "give one of them another `name`"
            )
        files[entry.name] = entry.file


def default_entry(file: str) -> AssetEntry:
    """The entry of a file for which the user gives no settings."""
    path = Path(file)
    stem = path.parent.name if path.stem.lower() == "model" and path.parent.name else path.stem
    return _named({"file": file, "name": "_".join(stem.split())})


def _named(values: dict[str, Any]) -> AssetEntry:
    file = Path(values["file"])
    values.setdefault("name", "_".join(file.stem.split()))
    values.setdefault("display_name", " ".join(values["name"].replace("_", " ").split()) or values["name"])
    values.setdefault("plural", regular_plural(values["display_name"]))
    values.setdefault("up", "z")
    return AssetEntry(**values)


def _entry(item: Any, where: str, folder: Path) -> AssetEntry:
    if not isinstance(item, Mapping):
        raise InvalidInputError(f"{where} must be a mapping such as `file: mug.urdf`, got {item!r}")
    known = [field.name for field in fields(AssetEntry)]
    for key in item:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.4)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise InvalidInputError(f"{where}: unknown key {key!r}{hint} Known: {', '.join(known)}.")
    if not isinstance(item.get("file"), str) or not item["file"]:
        raise InvalidInputError(f"{where} needs a `file`")
    where = f"{where} ({item['file']})"
    path = folder / item["file"]
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidInputError(f"{where}: files of type {path.suffix!r} cannot be read; known: {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InvalidInputError(f"{where}: there is no such file in {folder}")
    values = {key: _value(key, value, where) for key, value in item.items() if value is not None}
    if "mass" in values and "density" in values:
        raise InvalidInputError(f"{where}: give mass or density, not both")
    if values.get("welded") and ("mass" in values or "density" in values):
        raise InvalidInputError(f"{where}: a welded asset has no mass; drop `mass` and `density`, or `welded`")
    return _named(values)


def _value(key: str, value: Any, where: str) -> Any:
    if key in _TEXTS:
        if not isinstance(value, str) or not value.strip():
            raise InvalidInputError(f"{where}: {key} must be text, got {value!r}; put it in quotes")
        return value.strip()
    if key in _NUMBERS:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not math.isfinite(value) or value <= 0:
            raise InvalidInputError(f"{where}: {key} must be a number above 0, got {value!r}")
        return float(value)
    if key in _CHOICES:
        if value not in _CHOICES[key]:
            raise InvalidInputError(f"{where}: {key} must be one of {', '.join(_CHOICES[key])}, got {value!r}")
        return value
    if key == "welded":
        if not isinstance(value, bool):
            raise InvalidInputError(f"{where}: welded must be true or false, got {value!r}")
        return value
    return _color(value, where)


def _color(value: Any, where: str) -> Color:
    """(r, g, b) from a list of three integers, or from "#rrggbb"."""
    if isinstance(value, str) and value.startswith("#") and len(value) == 7:
        try:
            return (int(value[1:3], 16), int(value[3:5], 16), int(value[5:7], 16))
        except ValueError:
            pass
    is_list = isinstance(value, list) and len(value) == 3
    if is_list and all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v <= 255 for v in value):
        return (value[0], value[1], value[2])
    raise InvalidInputError(f"{where}: color must be [r, g, b] in 0..255 or '#rrggbb', got {value!r}")
