"""Formats of exports: built-in ones, those of installed packages, and users' own; imports no torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.registry import Registry

if TYPE_CHECKING:
    from scene_envs.export.placed import AssetFiles, PlacedScene

SceneWriter = Callable[["PlacedScene", "AssetFiles", Path], Path]
"""Function that writes one scene into its folder and assets into theirs, and returns the main file."""
BatchWriter = Callable[[Sequence["PlacedScene"], "AssetFiles", Path], Path]
"""Function that writes all scenes of an export into its folder and assets into theirs, and returns the main file."""

ENTRY_POINT_GROUP = "scene_envs.export_formats"
"""Packages offer formats under this group: an entry named after the format, whose value is a SceneWriter."""
_HERE = "scene_envs.export"


@dataclass(frozen=True)
class ExportFormat:
    """One format.

    Attributes:
        name: Name of the format in ``formats=``.
        summary: One line for listings.
        write: Writer, or its place as ``"module:function"``.
        requires: Module that the writer imports; empty for none.
        install: Package that holds this module.
        whole: Whether the writer is a BatchWriter: it is called once, for all scenes.
    """

    name: str
    summary: str
    write: SceneWriter | BatchWriter | str
    requires: str = ""
    install: str = ""
    whole: bool = False

    def writer(self) -> Any:
        """The writer, imported; raises MissingDependencyError where the required module is not installed."""
        if self.requires and find_spec(self.requires) is None:
            raise MissingDependencyError(
                f"format {self.name!r} needs {self.install}, which is not installed; "
                f"install it with `pip install {self.install}`, or leave {self.name!r} out of formats="
            )
        if not isinstance(self.write, str):
            return self.write
        module, _, function = self.write.partition(":")
        return getattr(import_module(module), function)


_SHIPPED = (
    ExportFormat("urdf", "URDF per asset, poses as JSON", f"{_HERE}.urdf:write_scene"),
    ExportFormat("sdf", "SDF world (Gazebo, Drake)", f"{_HERE}.sdf:write_scene"),
    ExportFormat("drake", "Drake model directives", f"{_HERE}.drake:write_scene"),
    ExportFormat("mjcf", "MJCF (MuJoCo)", f"{_HERE}.mjcf:write_scene"),
    ExportFormat("usd", "USD with UsdPhysics", f"{_HERE}.usd:write_scene", "pxr", "usd-core"),
    ExportFormat("glb", "coloured mesh, no physics", f"{_HERE}.arrays:write_scene"),
    ExportFormat("npz", "numpy arrays", f"{_HERE}.arrays:write_npz"),
    ExportFormat("worlds", "one MuJoCo model, a world per scene", f"{_HERE}.worlds:write_worlds", whole=True),
)
_FORMATS = Registry(
    "export format",
    ENTRY_POINT_GROUP,
    {entry.name: entry for entry in _SHIPPED},
    read=lambda point: ExportFormat(point.name, f"from {point.module}", point.value),
)


def register_format(name: str, *, summary: str = "") -> Callable[[SceneWriter], SceneWriter]:
    """Make the decorated function the writer of format ``name``; the same name again replaces it.

    The function takes ``(scene: PlacedScene, files: AssetFiles, folder: Path)``, writes the scene into ``folder`` and
    returns the path of its main file. ``files`` gives the meshes of assets, which are shared by all scenes.

    >>> @register_format("doctest_poses", summary="one line per object")
    ... def write(scene, files, folder):
    ...     path = folder / "poses.txt"
    ...     path.write_text("".join(f"{o.name} {o.translation.tolist()}" for o in scene.objects))
    ...     return path
    >>> "doctest_poses" in list_formats()
    True
    """
    _FORMATS.check_name(name, "my_format")
    return _FORMATS.adding(
        name, lambda write: ExportFormat(name, summary or (write.__doc__ or "").strip().split("\n")[0], write)
    )


def list_formats() -> list[str]:
    """Names of all formats, those of installed packages included, sorted."""
    return _FORMATS.names()


def resolve_formats(formats: str | Sequence[str]) -> tuple[str, ...]:
    """Names of formats, each once, from one name, several, or ``"all"`` (those with a file per scene that can be
    written here). Raises UnknownNameError, MissingDependencyError for a format without its package, and
    InvalidInputError for none.

    >>> resolve_formats(["mjcf", "npz", "mjcf"])
    ('mjcf', 'npz')
    """
    if formats == "all":
        formats_here = (f for f in _FORMATS.values() if not f.requires or find_spec(f.requires) is not None)
        return tuple(f.name for f in formats_here if not f.whole)
    if not isinstance(formats, Sequence) or not all(isinstance(name, str) for name in formats):
        raise InvalidInputError(f"formats={formats!r} is no list of names; known: {', '.join(list_formats())}")
    names = (formats,) if isinstance(formats, str) else tuple(dict.fromkeys(formats))
    if not names:
        raise InvalidInputError(f"formats is empty; give at least one of {', '.join(list_formats())}")
    for name in names:
        _FORMATS[name].writer()
    return names
