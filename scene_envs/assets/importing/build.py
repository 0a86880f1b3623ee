"""Import of one file as an asset: its entry in ``library.yaml``, the body it becomes, and the report."""

from __future__ import annotations

import colorsys
import dataclasses
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, get_args

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset, ConvexPart, Joint, bounds_of, identifiers, regular_plural
from scene_envs.assets.importing.limits import seconds_left
from scene_envs.assets.importing.mesh_files import (
    MESH_SUFFIXES,
    Y_UP,
    Color,
    Model,
    Shape,
    heavier,
    merged_inertial,
    moved_inertial,
)
from scene_envs.assets.importing.robot_files import read_mjcf, read_sdf, read_urdf, read_usd
from scene_envs.assets.importing.solids import (
    Method,
    PartAudit,
    collision_of,
    enclosing_hull,
    file_meshes,
    meshes_of,
    thickness,
    visual_of,
)
from scene_envs.assets.shapes import MassProperties, join, mass_properties, moved, pose_of
from scene_envs.errors import Checked, CorruptFileError, InvalidInputError, Limit, Positive, unknown_name
from scene_envs.files import read_yaml

if TYPE_CHECKING:
    import trimesh


YAML_NAMES = ("library.yaml", "library.yml")
SUFFIXES = (".urdf", ".sdf", ".xml", ".usd", ".usda", ".usdc", *MESH_SUFFIXES)
"""Files that can become assets."""
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Base = Literal["bottom", "origin"]
DEFAULT_DENSITY = 500.0
"""Density (kg/m^3) used where neither the file nor the user gives one: wood, or a ceramic vessel with its air."""
_POSSIBLE = (1.0, 23_000.0)
"""Possible densities, kg/m^3, from air to osmium."""
_FACTOR = 10.0
"""Largest factor between a moment of inertia and that of the same shape filled evenly."""
_CONVEX = 0.01
"""Depth below the hull, as a fraction of the diagonal, up to which a body counts as convex."""
_MAX_CONVEX = 2e-3
"""Upper limit (m) of that depth."""
_THIN = 3e-3
"""Parts thinner than this (m) get a note: the collision margins of physics engines take up much of them."""
_MANY_PARTS, _MANY_TRIANGLES = 64, 200_000
_UNLIKE = 0.01
"""Difference (m) between the bounding boxes of visual and collision geometry that is worth a note."""
_SMALL, _LARGE = 2e-3, 20.0
"""Smallest and largest plausible diagonal (m); beyond them the file is probably not in metres."""


def _one_of(words: Any) -> Limit:
    return Limit(lambda value: value in get_args(words), f"must be one of {', '.join(get_args(words))}")


_Text = Annotated[str, Limit(lambda value: isinstance(value, str) and value != "", "must be text; put it in quotes")]


@dataclass(frozen=True)
class AssetEntry(Checked):
    """One asset of a library: its file, its names and how its file becomes a body."""

    file: _Text  # relative to the folder
    name: _Text = ""  # identifier; by default the stem of the file
    display_name: _Text = ""  # in prompts; by default the identifier with spaces
    plural: _Text = ""  # of the display name; the regular one by default
    scale: Positive = 1.0  # factor on all lengths; a file in millimetres needs 0.001
    density: Positive | None = None  # kg/m^3, of the evenly filled shape
    mass: Positive | None = None  # kg
    welded: bool | None = None  # to the world; the file decides by default
    up: Annotated[Axis, _one_of(Axis)] = "z"  # axis of the file that points up
    color: Color | None = None  # class colour (r, g, b), also for surfaces without one
    base: Annotated[Base, _one_of(Base)] = "bottom"  # frame under the middle of the bounding box, or as in the file
    decomposition: Annotated[Method, _one_of(Method)] = "auto"  # see convex_parts
    concavity: Positive = 0.05  # CoACD's threshold, 0.01 (many parts) to 1 (one)


def read_entries(path: Path) -> list[AssetEntry]:
    """The entries of a YAML file: a list of mappings, one per asset. Raises CorruptFileError, with the line, for a file
    that is not YAML, and InvalidInputError for a wrong key or value, a missing file or a repeated name.
    """
    import yaml

    try:
        content = read_yaml(path)
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
    values.setdefault("display_name", " ".join(str(values["name"]).replace("_", " ").split()) or values["name"])
    values.setdefault("plural", regular_plural(str(values["display_name"])))
    return AssetEntry(**values)


def _entry(item: Any, where: str, folder: Path) -> AssetEntry:
    if not isinstance(item, Mapping):
        raise InvalidInputError(f"{where} must be a mapping such as `file: mug.urdf`, got {item!r}")
    known = [field.name for field in fields(AssetEntry)]
    if unknown := [str(key) for key in item if key not in known]:
        raise InvalidInputError(f"{where}: {unknown_name('key', unknown[0], known)}")
    if not isinstance(item.get("file"), str) or not item["file"]:
        raise InvalidInputError(f"{where} needs a `file`")
    where = f"{where} ({item['file']})"
    path = folder / item["file"]
    if path.suffix.lower() not in SUFFIXES:
        raise InvalidInputError(f"{where}: files of type {path.suffix!r} cannot be read; known: {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise InvalidInputError(f"{where}: there is no such file in {folder}")
    texts = {key: value.strip() if isinstance(value, str) else value for key, value in item.items()}
    values = {key: value for key, value in texts.items() if value is not None}
    if "mass" in values and "density" in values:
        raise InvalidInputError(f"{where}: give mass or density, not both")
    if values.get("welded") and ("mass" in values or "density" in values):
        raise InvalidInputError(f"{where}: a welded asset has no mass; drop `mass` and `density`, or `welded`")
    if not isinstance(values.get("welded", True), bool):
        raise InvalidInputError(f"{where}: welded must be true or false, got {values['welded']!r}")
    if "color" in values:
        values["color"] = _color(values["color"], where)
    try:
        return _named(values)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


def _color(value: Any, where: str) -> Color:
    """(r, g, b) from a list of three integers, or from "#rrggbb"."""
    if isinstance(value, str) and re.fullmatch("#[0-9a-fA-F]{6}", value):
        return (int(value[1:3], 16), int(value[3:5], 16), int(value[5:7], 16))
    is_list = isinstance(value, list) and len(value) == 3
    if is_list and all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v <= 255 for v in value):
        return (value[0], value[1], value[2])
    raise InvalidInputError(f"{where}: color must be [r, g, b] in 0..255 or '#rrggbb', got {value!r}")


def weigh(
    given: MassProperties | None, parts: Sequence[ConvexPart], solid: MassProperties, entry: AssetEntry
) -> tuple[MassProperties, tuple[str, ...], tuple[str, ...]]:
    """Mass properties of an asset of these fine parts whose ``solid`` is given at 1 kg/m^3, with notes and warnings.
    Those ``given`` by the file are kept where they are possible; an inertia of zeros is missing. A user's ``mass`` (kg)
    keeps the file's distribution; a user's ``density`` (kg/m^3) fills the shape evenly.
    """
    mass = entry.mass
    if entry.density is not None:
        return (heavier(solid, entry.density), (), ())
    if given is None or given.mass <= 0:
        known = "inertia computed from the shape"
        if mass is None:
            known, mass = f"mass and {known} at {DEFAULT_DENSITY:g} kg/m^3", DEFAULT_DENSITY * solid.mass
        why = "the file gives none" if given is None else f"the file gives a mass of {given.mass:g} kg"
        return (heavier(solid, mass / solid.mass), (f"{known}: {why}",), ())
    if mass is None:
        found = given.mass / solid.mass
        if not _POSSIBLE[0] <= found <= _POSSIBLE[1]:
            reason = f"the file's {given.mass:g} kg would be {found:.3g} kg/m^3"
            text = f"mass and inertia recomputed at {DEFAULT_DENSITY:g} kg/m^3: {reason}"
            return (heavier(solid, DEFAULT_DENSITY), (), (text,))
        mass = given.mass
    inertia, even = given.inertia * (mass / given.mass), heavier(solid, mass / solid.mass)
    notes: tuple[str, ...] = ()
    if not inertia.any():
        inertia, notes = even.inertia, ("inertia computed from the shape: the file gives none",)
    wrong = why_impossible(inertia, given.center_of_mass, parts, even)
    if wrong:
        return (even, (), (f"centre of mass and inertia recomputed from the shape: {wrong}",))
    inertia = 0.5 * (inertia + inertia.T)
    low, middle, high = np.linalg.eigvalsh(inertia)
    inertia += max(0.0, high * (1.0 + 1e-9) - low - middle) * np.eye(3)  # MuJoCo refuses a plate by a rounding
    return (MassProperties(mass, given.center_of_mass, inertia), notes, ())


def why_impossible(inertia: Array, center: Array, parts: Sequence[ConvexPart], computed: MassProperties) -> str:
    """Reason why a body of this shape cannot have this inertia (3, 3) and centre of mass (3,); empty if possible.

    >>> from scene_envs.assets.shapes import box
    >>> cube = [box((0.1, 0.1, 0.1))]
    >>> why_impossible(np.eye(3), np.zeros(3), cube, mass_properties(cube, 1.0))
    'the inertia, moments (1, 1, 1) kg m^2, is 600 times that of the shape'
    """
    moments = np.linalg.eigvalsh(0.5 * (inertia + inertia.T))
    shown = f"the inertia, moments ({', '.join(f'{m:.3g}' for m in moments)}) kg m^2,"
    if moments[0] <= 0:
        return f"{shown} is not positive"
    if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-4):
        return f"{shown} breaks the triangle inequality"
    expected = np.linalg.eigvalsh(computed.inertia)
    ratio = moments / expected
    worst = ratio[np.abs(np.log(ratio)).argmax()]
    if not 1.0 / _FACTOR <= worst <= _FACTOR:
        return f"{shown} is {worst:.3g} times that of the shape"
    low, high = bounds_of(parts)
    margin = 1e-3 * np.linalg.norm(high - low)
    if (center < low - margin).any() or (center > high + margin).any():
        return f"the centre of mass ({', '.join(f'{c:.3g}' for c in center)}) m lies outside the shape"
    return ""


@dataclass(frozen=True)
class AssetReport:
    """Import report of one file.

    Attributes:
        name: Name of the asset.
        file: File that the asset was read from.
        mass: Mass, kg; 0 for welded assets.
        density: Density of the solid, kg/m^3; 0 for welded assets.
        parts: Number of fine convex parts.
        origin: Position (x, y, z) of the origin of the file in the asset frame, m.
        notes: Assumptions and choices.
        warnings: Faults of the file, corrected where possible.
        error: Reason why there is no asset; empty when there is one.
        audit: Comparison of the drawn mesh with the convex parts; None for a mesh of more than 100,000 triangles.
    """

    name: str
    file: Path
    mass: float = 0.0
    density: float = 0.0
    parts: int = 0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    error: str = ""
    audit: PartAudit | None = None

    def __str__(self) -> str:
        if self.error:
            return f"{self.name}: not imported: {self.error}"
        weight = f"{self.mass:.4g} kg" if self.mass > 0 else "welded"
        pieces = f"{self.parts} convex part{'s' if self.parts != 1 else ''}"
        compared = () if self.audit is None else (str(self.audit),)
        return "; ".join([f"{self.name}: {self.file.name}, {weight}, {pieces}", *self.warnings, *self.notes, *compared])


@dataclass(frozen=True)
class ImportReport:
    """Import report of a folder.

    Attributes:
        folder: Folder that was read.
        assets: One report per file.
        notes: Notes about the folder as a whole.
    """

    folder: Path
    assets: tuple[AssetReport, ...]
    notes: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> AssetReport:
        """The report of the asset called ``name``; KeyError without one."""
        return {report.name: report for report in self.assets}[name]

    def __str__(self) -> str:
        return "\n".join([f"{self.folder}: {len(self.assets)} assets", *self.notes, *map(str, self.assets)])


def build_asset(path: Path, entry: AssetEntry) -> tuple[Asset, AssetReport]:
    """The asset that ``entry`` makes of the file at ``path``, and its import report. Raises InvalidInputError for a
    missing mesh or a model without volume, CorruptFileError, and MissingDependencyError for a format or method without
    its package.
    """
    model = _scaled(_read(path), entry)
    notes, warnings = list(model.notes), []
    shapes = model.collisions or model.visuals
    if not shapes:
        raise InvalidInputError(f"{path} has neither visual nor collision geometry")
    if not model.collisions:
        notes.append("no collision geometry: the visual one is used")
    size = _diagonal(shapes)
    if not _SMALL <= size <= _LARGE:
        warnings.append(f"it is {size:.3g} m large; if the file is not in metres, set `scale`")
    pieces = _collide(shapes, entry, size, path, notes, warnings)
    parts, solid = [part for piece in pieces for part in piece.parts], merged_inertial([p.solid for p in pieces])
    static = model.static is True if entry.welded is None else entry.welded
    if entry.welded is None and (entry.mass is not None or entry.density is not None):
        static = False
    if static and model.faults:
        raise CorruptFileError("; ".join(model.faults))
    notes += model.faults
    properties, remarks, faults = weigh(_given(model, {}), parts, solid, entry)
    if static:
        properties, remarks, faults = mass_properties(parts, 0.0), (), ()
    notes += remarks
    warnings += faults
    drawn = [(shape.link, visual_of(shape, entry.color)) for shape in model.visuals or shapes]
    visual = join(*(mesh for _, meshes in drawn for mesh in meshes))
    meshes = [shape for shape in (*model.visuals, *shapes) if shape.kind == "mesh"]
    notes += dict.fromkeys(
        note for shape in meshes for mesh in meshes_of(shape) for note in mesh.metadata.get("notes", ())
    )
    shift = _shift(parts, entry, visual if static else None)
    apart = float(np.abs(np.asarray(visual.bounds) - bounds_of(parts)).max())
    if apart > max(_UNLIKE, 0.05 * size):
        notes.append(f"the boxes of visual and collision geometry differ by up to {apart:.2g} m")
    fine = tuple(_shifted(part, shift) for part in parts)
    if len(visual.faces) > _MANY_TRIANGLES:
        notes.append(f"{len(visual.faces)} triangles to draw; pictures will be slow")
    joints, bodies = _articulate(model, pieces, drawn, entry, shift, notes, warnings if static else [])
    if joints:
        where = "frozen at zero, and kept in exports" if static else "frozen at zero"
        notes.append(f"movable joints {where}: {', '.join(joint.name for joint in joints)}")
    asset = Asset(
        name=entry.name,
        display_name=entry.display_name,
        plural=entry.plural,
        mass=properties.mass,
        center_of_mass=properties.center_of_mass + shift,
        inertia=properties.inertia,
        visual=moved(visual, np.eye(3), shift),
        fine=fine,
        coarse=fine if len(fine) == 1 else (enclosing_hull(fine),),
        color=entry.color or (128, 128, 128),
        static=static,
        joints=joints,
        bodies=bodies,
    )
    x, y, z = (shift + 0.0).tolist()
    density = 0.0 if static else properties.mass / solid.mass
    said = tuple(notes), tuple(warnings)
    return asset, AssetReport(entry.name, path, properties.mass, density, len(fine), (x, y, z), *said)


def _given(model: Model, rows: Mapping[int, int], row: int = 0) -> MassProperties | None:
    """What the file gives for the body that has this row, by the joints of its links; by default all is one body."""
    own = [inertial for link, inertial in model.inertials if rows.get(link, 0) == row]
    return merged_inertial(own) if own else None


def _articulate(
    model: Model,
    pieces: Sequence[_Piece],
    drawn: Sequence[tuple[int, list[trimesh.Trimesh]]],
    entry: AssetEntry,
    shift: Array,
    notes: list[str],
    warnings: list[str],
) -> tuple[tuple[Joint, ...], tuple[Asset, ...]]:
    """The joints whose links can be seen and touched, and the bodies that they connect; other links stay with what they
    hang on.
    """
    solid = {piece.link for piece in pieces} & {link for link, _ in drawn}
    rows, kept, has_base = {0: 0}, list[int](), 0 in solid
    for index, joint in enumerate(model.joints, start=1):
        rows[index] = parent = rows[joint.parent]
        if index in solid and (parent or has_base):
            kept.append(index)
            rows[index] = len(kept)
        else:
            has_base |= index in solid
            notes.append(f"movable joint frozen at zero: {joint.name} (it joins what has no shape)")
    if not kept:
        return (), ()
    taken = (entry.name, "joints", "base")  # names that exports give
    names = identifiers([*taken, *(model.joints[index - 1].link for index in kept)])
    titles = identifiers(model.joints[index - 1].name for index in kept)
    joints, bodies, frames = list[Joint](), list[Asset](), [np.eye(4)]
    for row, index in enumerate([0, *kept]):
        if row:
            joint = model.joints[index - 1]
            frames.append(joint.pose)
            parent, link = rows[joint.parent], names[joint.link]
            pose = np.linalg.inv(frames[parent]) @ joint.pose
            pose[:3, 3] += 0.0 if parent else shift
            joints.append(dataclasses.replace(joint, name=titles[joint.name], link=link, parent=parent, pose=pose))
        back: Any = np.linalg.inv(frames[row]) if row else pose_of(shift, np.eye(3))
        own = [piece for piece in pieces if rows[piece.link] == row]
        parts = [part for piece in own for part in piece.parts]
        even = merged_inertial([piece.solid for piece in own])
        weight, _, faults = weigh(_given(model, rows, row), parts, even, dataclasses.replace(entry, mass=None))
        name = joints[-1].link if row else "base"
        warnings += [f"link {name!r}: {text}" for text in faults if row]
        mass, center, inertia = moved_inertial(back, weight)
        look = join(*(mesh for link, meshes in drawn if rows[link] == row for mesh in meshes))
        look = moved(look, back[:3, :3], back[:3, 3])
        turned = [ConvexPart(part.vertices @ back[:3, :3].T, part.faces) for part in parts]
        fine = tuple(_shifted(part, back[:3, 3]) for part in turned)
        looks: dict[str, Any] = {"visual": look, "fine": fine, "coarse": fine, "color": entry.color or (128, 128, 128)}
        bodies.append(Asset(f"{entry.name}/{name}", name, name, mass, center, inertia, static=not row, **looks))
    return tuple(joints), tuple(bodies)


def _read(path: Path) -> Model:
    suffix = path.suffix.lower()
    readers = {".urdf": read_urdf, ".sdf": read_sdf, ".xml": read_mjcf}
    if reader := read_usd if suffix.startswith(".usd") else readers.get(suffix):
        return reader(path)
    pose = pose_of(np.zeros(3), file_meshes(path)[0].metadata["upright"])
    shape = Shape("mesh", (1.0, 1.0, 1.0), pose, "the mesh", path)
    return Model(visuals=(shape,), collisions=(shape,))


def _scaled(model: Model, entry: AssetEntry) -> Model:
    """The model scaled, with its up axis turned to +z; the density is kept, so the mass grows with the scale cubed."""
    turn, scale = _upright(entry.up), entry.scale

    @cache  # a mesh that is drawn and collides is read once
    def shape(old: Shape) -> Shape:
        pose = pose_of(scale * turn @ old.pose[:3, 3], turn @ old.pose[:3, :3])
        return dataclasses.replace(old, pose=pose, size=tuple(scale * s for s in old.size))

    inertials = tuple(
        (k, MassProperties(i.mass * scale**3, scale * turn @ i.center_of_mass, scale**5 * turn @ i.inertia @ turn.T))
        for k, i in model.inertials
    )
    far = {"prismatic": scale, "revolute": 1.0}
    joints = tuple(
        dataclasses.replace(
            j,
            pose=pose_of(scale * turn @ j.pose[:3, 3], turn @ j.pose[:3, :3]),
            limits=(j.limits[0] * far[j.kind], j.limits[1] * far[j.kind]),
        )
        for j in model.joints
    )
    notes = model.notes
    if scale != 1.0 and any(i.mass > 0 for _, i in model.inertials) and entry.mass is None and entry.density is None:
        notes = (*notes, f"mass scaled by {scale:g} cubed")
    visuals, collisions = (tuple(map(shape, some)) for some in (model.visuals, model.collisions))
    return dataclasses.replace(
        model, visuals=visuals, collisions=collisions, inertials=inertials, notes=notes, joints=joints
    )


def _upright(up: Axis) -> Array:
    """(3, 3) rotation that takes the axis ``up`` to +z, about one other axis."""
    quarter = {
        "z": np.eye(3),
        "y": Y_UP,
        "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        "-z": np.diag([1.0, -1.0, -1.0]),
    }
    return quarter[up] if up in quarter else quarter["-z"] @ quarter[up[1:]]


class _Piece(NamedTuple):
    """A shape that collides."""

    link: int  # as of the shape
    parts: list[ConvexPart]
    solid: MassProperties  # at 1 kg/m^3


def _diagonal(shapes: Sequence[Shape]) -> float:
    """Length (m) of the diagonal of the bounding box of all shapes."""
    meshes = [mesh for s in shapes for mesh in (meshes_of(s) if s.kind == "mesh" else visual_of(s, None))]
    return float(np.linalg.norm(np.ptp(np.concatenate([mesh.bounds for mesh in meshes]), axis=0)))


def _collide(
    shapes: Sequence[Shape], entry: AssetEntry, size: float, path: Path, notes: list[str], warnings: list[str]
) -> list[_Piece]:
    """Fine parts and solids of all shapes; adds remarks to ``notes`` and ``warnings``."""
    tolerance = min(_CONVEX * size, _MAX_CONVEX)
    pieces: list[_Piece] = []
    repeated = 0
    seen: set[bytes] = set()
    for shape in shapes:
        found = collision_of(shape, entry.decomposition, tolerance, entry.concavity)
        key = b"".join(np.round(part.vertices, 7).tobytes() for part in found.parts)
        if key and key in seen:
            repeated += 1
            continue
        seen.add(key)
        pieces += [_Piece(shape.link, found.parts, found.solid)] if found.parts else []
        seconds_left()
        notes += [note for note in found.notes if note not in notes]
        warnings += [warning for warning in found.warnings if warning not in warnings]
    parts = [part for piece in pieces for part in piece.parts]
    if not parts:
        raise InvalidInputError(f"{path} spans no volume: all corners of its collision geometry lie in one plane")
    if repeated:
        notes.append(f"{repeated} repeated collision shape{'s' if repeated > 1 else ''} left out")
    widths = [thickness(part) for part in parts]
    thin = sum(width < _THIN for width in widths)
    if thin:
        notes.append(f"{thin} of {len(parts)} parts thinner than 3 mm (the thinnest {1e3 * min(widths):.2g} mm)")
    if len(parts) > _MANY_PARTS:
        notes.append(f"{len(parts)} parts; physics will be slow, a larger `concavity` gives fewer")
    return pieces


def _shift(parts: Sequence[ConvexPart], entry: AssetEntry, visual: trimesh.Trimesh | None) -> Array:
    """(3,) m: position of the file's origin in the asset frame; the box includes ``visual`` when it is given."""
    if entry.base == "origin":
        return np.zeros(3)
    low, high = bounds_of(parts)
    if visual is not None:
        low, high = np.minimum(low, visual.bounds[0]), np.maximum(high, visual.bounds[1])
    return 0.0 - np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])


def _shifted(part: ConvexPart, shift: Array) -> ConvexPart:
    """The part in the asset frame; heights that are 0 up to rounding become exactly 0."""
    vertices = part.vertices + shift
    vertices[np.abs(vertices[:, 2]) < 1e-9, 2] = 0.0
    return ConvexPart(vertices, part.faces)


def distinct_colors(count: int, taken: Iterable[Color] = ()) -> list[Color]:
    """``count`` colours, each the candidate farthest from white and from all before it; the choice is deterministic.

    >>> colors = np.array(distinct_colors(20), dtype=float)
    >>> gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(20)
    >>> bool(gaps.min() > 60)
    True
    """
    tones = [(s, v) for v in (0.85, 0.6, 0.4) for s in (0.85, 0.55)]
    pool = np.rint(255.0 * np.array([colorsys.hsv_to_rgb(hue / 36.0, s, v) for s, v in tones for hue in range(36)]))
    gaps = np.full(len(pool), np.inf)
    for color in ((255, 255, 255), *taken):
        gaps = np.minimum(gaps, np.linalg.norm(pool - np.asarray(color), axis=1))
    chosen: list[Color] = []
    while len(chosen) < count:
        if gaps.max() < 1.0:  # every candidate is taken: begin again
            gaps = np.full(len(pool), np.inf)
        red, green, blue = pool[int(gaps.argmax())].astype(int).tolist()
        chosen.append((red, green, blue))
        gaps = np.minimum(gaps, np.linalg.norm(pool - (red, green, blue), axis=1))
    return chosen
