"""Export of scenes and their assets into a folder."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene_envs.assets.base import identifier
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.export.formats import _FORMATS, resolve_formats
from scene_envs.export.placed import AssetFiles, PlacedObject, place
from scene_envs.export.randomization import randomize, read_randomization, record
from scene_envs.files import write_json
from scene_envs.physics.parts import FRICTION
from scene_envs.scene import SceneBatch

MANIFEST = "export.json"
_WITH_JOINTS = ("urdf", "sdf", "drake", "mjcf", "usd")


@dataclass(frozen=True)
class ExportReport:
    """Files that an export wrote.

    Attributes:
        output: Folder of the export.
        formats: Formats in the given order.
        scenes: Main file of each format, for each scene.
        assets: Names of the assets in use.
        size: Size of the whole export, bytes.
        notes: For each asset with joints, the formats in which they move and those in which they are frozen.
    """

    output: Path
    formats: tuple[str, ...]
    scenes: tuple[Mapping[str, Path], ...]
    assets: tuple[str, ...]
    size: int
    notes: tuple[str, ...] = ()


def export(
    batch: SceneBatch,
    output: str | os.PathLike[str],
    formats: str | Sequence[str] = "all",
    *,
    friction: float = FRICTION,
    randomization: str | os.PathLike[str] | Mapping[str, Any] = "",
) -> ExportReport:
    """Write scenes for simulators and viewers.

    ``output`` gets ``assets/<asset>/`` (meshes, convex parts, URDF; written once and shared) and ``scene_000/``,
    ``scene_001/``, … with one main file per format; ``worlds`` has one for all scenes. All paths inside are relative,
    so the folder can be moved. Poses are written in full double precision. More formats can be added to the same
    scenes by a second call; an interrupted export goes on when the same call is made again.

    Args:
        batch: B scenes. Their poses are not changed: make scenes simulation-ready first
            (:func:`scene_envs.physics.make_ready`) if they must stand still.
        output: Folder of the export; made if it does not exist. Other files in it are not touched.
        formats: One or several names, or ``"all"`` for those with a file per scene that can be written here; see
            :func:`scene_envs.export.list_formats`.
        friction: Coulomb friction coefficient between any two surfaces; by default that of :mod:`scene_envs.physics`.
        randomization: Distributions of mass, friction, colours, textures, light and camera
            (:mod:`scene_envs.export.randomization`); ``randomization.json`` of each scene says what it got.

    Raises:
        UnknownNameError: no such format.
        MissingDependencyError: a format needs a package that is not installed.
        InvalidInputError: a pose is not valid, or ``output`` holds an export of other scenes.
    """
    if not 0.0 <= friction < float("inf"):
        raise InvalidInputError(f"friction must be a finite number >= 0, got {friction}")
    names = resolve_formats(formats)
    writers = {name: _FORMATS[name].writer() for name in names}
    settings = read_randomization(randomization)
    seen: Counter[bytes] = Counter()
    placed = []
    for scene in place(batch, friction):
        placed.append(randomize(scene, settings, seen[scene.digest]))
        seen[scene.digest] += 1
    root = Path(output)
    manifest = _claim(root, batch, friction, settings)
    package = f"{identifier(batch.scene_type.name)}_{manifest['digest'][:8]}"
    files = AssetFiles(root / "assets", batch.scene_type.library.assets, friction, package)
    whole = {name: write(placed, files, root) for name, write in writers.items() if _FORMATS[name].whole}
    scenes = []
    for scene, place_of in zip(placed, scene_folders(len(placed)), strict=True):
        folder = root / place_of
        folder.mkdir(exist_ok=True)
        if settings:
            content = record(scene, settings, sorted({*manifest["formats"], *names}))
            write_json(folder / "randomization.json", content)
        scenes.append({name: whole.get(name) or write(scene, files, folder) for name, write in writers.items()})
        if not any(folder.iterdir()):
            folder.rmdir()
    manifest["formats"] = sorted({*manifest["formats"], *names})
    write_json(root / MANIFEST, manifest)
    used = tuple(dict.fromkeys(asset.name for scene in placed for asset in scene.assets))
    written = [
        path for top in ("worlds.*", "assets/**/*", "scene_[0-9]*", "scene_[0-9]*/**/*") for path in root.glob(top)
    ]
    size = sum(path.stat().st_size for path in written if path.is_file())
    jointed = {item.asset.name: item for scene in placed for item in scene.objects if item.asset.joints}
    notes = tuple(_joints_in(names, item) for item in jointed.values())
    return ExportReport(root, names, tuple(scenes), used, size, notes)


def _joints_in(formats: Sequence[str], item: PlacedObject) -> str:
    moving = [name for name in formats if name in _WITH_JOINTS and item.joints]
    frozen = [name for name in formats if name not in moving]
    verbs = [f"{verb} in {', '.join(some)}" for verb, some in (("move", moving), ("are frozen", frozen)) if some]
    free = "" if item.joints else ", because it is not welded"
    return f"{item.asset.name}: its joints ({', '.join(j.name for j in item.asset.joints)}) {' and '.join(verbs)}{free}"


def scene_folders(count: int) -> tuple[str, ...]:
    """Names of the folders of so many scenes."""
    return tuple(f"scene_{index:0{max(3, len(str(count - 1)))}d}" for index in range(count))


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of an export; raises CorruptFileError where it is none."""
    try:
        found = dict(json.loads(path.read_text()))
        types = {"scene_type": str, "scenes": int, "friction": float, "digest": str, "formats": list}
        return found | {key: kind(found[key]) for key, kind in types.items()}
    except (ValueError, KeyError, TypeError) as error:
        raise CorruptFileError(f"{str(path)!r} is no manifest of an export: {error}") from error


def _claim(root: Path, batch: SceneBatch, friction: float, randomization: Mapping[str, Any]) -> dict[str, Any]:
    """Claim the folder for this export; returns the manifest of an earlier export of the same scenes, or a new one."""
    try:
        root.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InvalidInputError(f"{str(root)!r} is a file, not a folder; choose another output") from None
    fresh: dict[str, Any] = {
        "scene_type": batch.scene_type.name,
        "scenes": len(batch),
        "friction": friction,
        "digest": _digest(batch),
        "formats": [],
    } | ({"randomization": randomization} if randomization else {})
    path = root / MANIFEST
    if path.exists():
        found = read_manifest(path)
        for key in ("scenes", "digest", "friction", "randomization"):
            if (there := found.get(key)) != (given := fresh.get(key)):
                which = f"these scenes with {key}={there}, not {given}" if key[0] in "fr" else "other scenes"
                raise InvalidInputError(
                    f"{str(root)!r} holds an export of {which}; choose another output, or remove that folder"
                )
        return found
    taken = sorted(path.name for pattern in ("assets", "scene_[0-9]*", "worlds.*") for path in root.glob(pattern))
    if taken:
        raise InvalidInputError(
            f"{str(root)!r} already holds {taken[0]!r}, which no export wrote; choose an empty folder as output"
        )
    write_json(root / MANIFEST, fresh)
    return fresh


def _digest(batch: SceneBatch) -> str:
    """Digest of the poses, and of the geometry and mass of the assets."""
    digest = hashlib.sha256(batch.tensor.cpu().contiguous().numpy().tobytes())
    digest.update(repr((batch.scene_type.assets, batch.scene_type.welded)).encode())
    for asset in (one for each in batch.scene_type.library for one in (each, *each.bodies)):
        digest.update(repr((asset.name, asset.mass, asset.static)).encode())
        digest.update(asset.inertia.tobytes() + asset.center_of_mass.tobytes())
        for part in asset.fine:
            digest.update(part.vertices.tobytes())
        digest.update(repr(asset.joints).encode() if asset.joints else b"")
    return digest.hexdigest()[:16]
