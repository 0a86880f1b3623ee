"""Asset library of a folder of model files."""

from __future__ import annotations

import contextlib
import logging
import os
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from scene_envs.assets.base import Asset, AssetLibrary
from scene_envs.assets.importing.build import (
    SUFFIXES,
    YAML_NAMES,
    AssetEntry,
    AssetReport,
    ImportReport,
    build_asset,
    check_names,
    default_entry,
    distinct_colors,
    read_entries,
)
from scene_envs.assets.importing.limits import READ_HERE, LargeImportError, in_time, seconds_left, timed, too_slow
from scene_envs.assets.importing.mesh_files import MESH_SUFFIXES, Color, find_mesh, read_xml
from scene_envs.assets.importing.robot_files import open_stage
from scene_envs.assets.importing.solids import audit_parts
from scene_envs.assets.recipes import RECIPES
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.workers import WorkerFailure, run_apart

_LOGGER = logging.getLogger(__name__)


def load_library(folder: str | os.PathLike[str]) -> AssetLibrary:
    """All assets of a folder of URDF, SDF, MJCF, USD, OBJ, STL, GLB, PLY, OFF or COLLADA files.

    ``library.yaml`` in the folder lists the assets; see :class:`AssetEntry` for its keys. Without it, every file that
    can be read becomes an asset with the name of the file, except what a model of the folder uses. Files
    that cannot be read are left out. The log and :func:`import_report` list these choices and all corrections. Each
    file is read once per process.

    Raises:
        InvalidInputError: no such folder or no assets in it, a wrong entry, or a mesh that does not exist.
        CorruptFileError: a file that ``library.yaml`` lists cannot be read; file and reason are named.
        MissingDependencyError: a format or method needs a package that is not installed.
    """
    index = folder_index(folder)
    assets: list[Asset] = []
    for entry in index.entries:
        try:
            assets.append(index.build(entry)[0])
        except SceneEnvsError as error:
            if index.is_listed:
                raise
            _LOGGER.warning("%s is left out: %s", index.folder / entry.file, error)
    if not assets:
        raise InvalidInputError(f"{index.folder} holds no file that can be read as an asset; the log says why")
    return AssetLibrary(tuple(assets))


def import_report(folder: str | os.PathLike[str]) -> ImportReport:
    """Report on the import of a folder: choices, corrections, how well the convex parts fit the mesh, unreadable files;
    ``str`` gives a line per asset.

    Raises as :func:`load_library` does for the folder and its YAML; files that cannot be read are in the report.
    """
    index = folder_index(folder)
    reports = []
    for entry in index.entries:
        try:
            asset, report = index.build(entry)
            reports.append(replace(report, audit=audit_parts(asset)))
        except SceneEnvsError as error:
            reports.append(AssetReport(entry.name, index.folder / entry.file, error=str(error)))
    return ImportReport(index.folder, tuple(reports), index.notes)


@dataclass(frozen=True, eq=False)
class FolderIndex:
    """The assets of a folder; each is built on first use."""

    folder: Path  # absolute path
    entries: tuple[AssetEntry, ...]  # entries of the assets, in the order of the library
    is_listed: bool  # whether ``library.yaml`` lists the assets
    notes: tuple[str, ...]  # assumptions about the folder

    @property
    def names(self) -> list[str]:
        """Asset names, in order."""
        return [entry.name for entry in self.entries]

    def build(self, entry: AssetEntry) -> tuple[Asset, AssetReport]:
        """The asset of an entry, and the report on its import; raises like :func:`load_library`."""
        path = self.folder / entry.file
        return _built(path, entry, _stamp(path))


def folder_index(folder: str | os.PathLike[str]) -> FolderIndex:
    """Index of a folder, without reading its models. Raises InvalidInputError for no such folder, no assets or a wrong
    entry, and CorruptFileError for an unreadable ``library.yaml``.
    """
    root = Path(folder).expanduser().resolve()
    if not root.is_dir():
        raise InvalidInputError(f"there is no folder {str(root)!r}; asset folders hold URDF, SDF or mesh files")
    for name in YAML_NAMES:
        if (root / name).is_file():
            return _listed(root / name, _stamp(root / name))
    return _unlisted(root, _stamp(root))


def _stamp(path: Path) -> tuple[int, int]:
    """Modification time (ns) and size of a file, which change when the file is written; zeros without access."""
    try:
        status = path.stat()
    except OSError:
        return (0, 0)
    return status.st_mtime_ns, status.st_size


@cache
def _listed(path: Path, stamp: tuple[int, int]) -> FolderIndex:
    return FolderIndex(path.parent, _colored(read_entries(path)), True, ())


@cache
def _unlisted(folder: Path, stamp: tuple[int, int]) -> FolderIndex:
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    files = [path for path in files if path.suffix.lower() != ".xml" or re.search(rb"<mujoco[\s>]", path.read_bytes())]
    used = {mesh for path in files if path.suffix.lower() not in MESH_SUFFIXES for mesh in _named_files(path)}
    entries = [default_entry(str(path.relative_to(folder))) for path in files if path.resolve() not in used]
    if not entries:
        raise InvalidInputError(f"{folder} holds no {', '.join(SUFFIXES)} files")
    check_names(entries, f"{folder} has no library.yaml, so assets are called after their files")
    note = f"no library.yaml: {len(entries)} files, named after themselves, in metres, welded where they say so"
    _LOGGER.info("%s: %s", folder, note)
    return FolderIndex(folder, _colored(entries), False, (note,))


def _named_files(path: Path) -> set[Path]:
    """The files that a URDF, SDF, MJCF or USD uses; empty when it cannot be read."""
    files, elements = [path], []
    with contextlib.suppress(SceneEnvsError, OSError):
        if path.suffix.lower().startswith(".usd"):
            stage = open_stage(path)
            return {Path(layer.realPath).resolve() for layer in stage.GetUsedLayers()} - {path.resolve()}
    for file in files:
        with contextlib.suppress(SceneEnvsError, OSError):
            elements += (new := [*read_xml(file).iter()])
            parts = [part.get("file") for part in new if part.tag in ("include", "model")]
            files += {(path.parent / part).resolve() for part in parts if part} - {*files}
    found, settings = {*files[1:]}, [element for element in elements if element.tag == "compiler"]
    places = [element.get("meshdir", element.get("assetdir", "")) for element in settings] or [""]
    is_bare = any(element.get("strippath") == "true" for element in settings)
    for mesh in (element for element in elements if element.tag == "mesh"):
        name = Path(mesh.get("file", ""))
        found |= {(path.parent / place / (name.name if is_bare else name)).resolve() for place in places}
        with contextlib.suppress(SceneEnvsError, OSError):
            found.add(find_mesh(mesh.get("filename") or mesh.findtext("uri") or "", path, "a mesh"))
    return found


def _colored(entries: list[AssetEntry]) -> tuple[AssetEntry, ...]:
    """Entries with a colour each, far from those of the built-in assets."""
    chosen: list[Color] = [entry.color for entry in entries if entry.color is not None]
    taken = [*(recipe.color for recipe in RECIPES.values()), *chosen]
    fresh = iter(distinct_colors(len(entries) - len(chosen), taken))
    return tuple(entry if entry.color is not None else replace(entry, color=next(fresh)) for entry in entries)


def build_in_time(request: tuple[Path, AssetEntry]) -> tuple[Asset, AssetReport]:
    """As :func:`~scene_envs.assets.importing.build.build_asset`, while the time of an import runs."""
    with timed(request[0]):
        return build_asset(*request)


@cache
def _built(path: Path, entry: AssetEntry, stamp: tuple[int, int]) -> tuple[Asset, AssetReport]:
    """As :func:`build_in_time`, large files in a process of their own; InvalidInputError when it is late or crashes."""
    try:
        with timed(path, READ_HERE):
            asset, report = in_time(lambda: build_asset(path, entry))
    except LargeImportError:
        with timed(path):
            try:
                asset, report = run_apart(f"{__name__}:build_in_time", (path, entry), seconds_left())
            except WorkerFailure as failure:
                if failure.is_late:
                    raise too_slow("") from None
                raise InvalidInputError(f"{path}: the import {failure}; simplify the file") from failure
    level = logging.WARNING if report.warnings else logging.INFO
    _LOGGER.log(level, "%s", report)
    return asset, report
