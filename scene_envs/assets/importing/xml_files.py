"""XML reader for models: numbers, colours and referenced files, with errors that name the place."""

from __future__ import annotations

import os
import re
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.importing.limits import check_file
from scene_envs.assets.importing.model import Color
from scene_envs.errors import CorruptFileError, InvalidInputError

_PREFIXED = re.compile(rb"(</?)([A-Za-z_][\w.-]*):([A-Za-z_][\w.-]*)")
"""An element with a namespace prefix, such as <drake:declare_convex/>."""


def read_xml(path: Path) -> Element:
    """The root element of an XML file; prefixes that are never declared are tolerated.

    Raises:
        CorruptFileError: the file cannot be read or is not XML; the line is named.
        InvalidInputError: the file is larger than imports may be.
    """
    check_file(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CorruptFileError(f"{path} cannot be read: {error.strerror or error}") from error
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        if "unbound prefix" in str(error):
            try:
                return ElementTree.fromstring(_PREFIXED.sub(rb"\1\2.\3", data))
            except ElementTree.ParseError as other:
                error = other
        raise CorruptFileError(f"{path} is not well-formed XML: {error}") from error


def numbers(text: str | None, count: int, path: Path, where: str, default: tuple[float, ...] | None = None) -> Array:
    """``count`` finite numbers from text; ``default`` when there is none.

    Raises:
        CorruptFileError: the text is anything else; file and place are named.
    """
    if text is None or not text.strip():
        if default is None:
            raise CorruptFileError(f"{path}: {where} is missing; it needs {count} number{'s' if count > 1 else ''}")
        return np.array(default, dtype=np.float64)
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        hint = "; expand it with xacro first" if "$" in text else ""
        raise CorruptFileError(f"{path}: {where} is {text.strip()!r}, which is not numbers{hint}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise CorruptFileError(f"{path}: {where} must be {count} finite number(s), got {text.strip()!r}")
    return values


def positive(text: str | None, count: int, path: Path, where: str) -> tuple[float, ...]:
    """``count`` numbers above 0; raises CorruptFileError otherwise."""
    values = numbers(text, count, path, where)
    if not (values > 0).all():
        raise CorruptFileError(f"{path}: {where} must be above 0, got {text!r}")
    return tuple(values.tolist())


def color_of(text: str | None, path: Path, where: str) -> Color | None:
    """(r, g, b) in 0..255 from "r g b a" in 0..1; None without text."""
    if text is None:
        return None
    values = numbers(text, len(text.split()), path, where)
    if len(values) < 3:
        raise CorruptFileError(f"{path}: {where} must be r g b [a] in 0..1, got {text!r}")
    red, green, blue = np.rint(255.0 * np.clip(values[:3], 0.0, 1.0)).astype(int).tolist()
    return (red, green, blue)


def find_mesh(uri: str, path: Path, where: str) -> Path:
    """The file that ``uri`` names in the model at ``path``: relative, absolute, file://, package:// or model://.

    A package is searched among the folders above the model, and in ``ROS_PACKAGE_PATH``.

    Raises:
        InvalidInputError: there is no such file; the places that were searched are named.
    """
    text = uri.strip()
    scheme, separator, rest = text.partition("://")
    if not separator:
        scheme, rest = "", text
    rest = rest.replace("\\", "/")
    folder = path.parent
    candidates = [Path(rest)] if scheme == "file" else [folder / rest]
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        for parent in (folder, *folder.parents):
            candidates += [parent / rest, parent / inside] if parent.name == package else [parent / rest]
        roots = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
        candidates += [candidate for root in roots for candidate in (Path(root) / rest, Path(root) / inside)]
        candidates.append(folder / inside)
    elif scheme not in ("", "file"):
        raise InvalidInputError(f"{path}: {where} refers to {uri!r}; only files, package:// and model:// can be read")
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
    more = ", the folders above it or ROS_PACKAGE_PATH" if scheme in ("package", "model") else ""
    raise InvalidInputError(f"{path}: {where} refers to the mesh {uri!r}, which does not exist in {folder}{more}")
