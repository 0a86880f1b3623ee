"""Scenes for file formats: named objects with exact poses in double precision."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trimesh.exchange.obj import export_obj
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset, ConvexPart, Joint, identifiers
from scene_envs.assets.shapes import convex_hull, pose_of
from scene_envs.errors import InvalidInputError
from scene_envs.physics.parts import FRICTION, quaternions
from scene_envs.render.raster import Pinhole
from scene_envs.scene_types import Camera, SceneType

if TYPE_CHECKING:
    from scene_envs.scene import SceneBatch

_MAX_COLORS = 1024
_CELL = 4
"""Width of a colour's cell in the palette, pixels."""
_PATTERN = 256
"""Width and height of a procedural texture, pixels."""
TEXTURES = ("none", "checker", "gradient", "flat")
"""An object's own colours, or a pattern in place of them: 8 by 8 cells of white and grey, white to grey, or white."""


@dataclass(frozen=True)
class Light:
    """A far lamp.

    Attributes:
        direction: Unit vector (x, y, z) in which it shines, world frame.
        intensity: Factor of the brightness that a format gives its lamp.
        color: Red, green and blue, 0 to 1.
    """

    direction: tuple[float, ...] = (-0.2, 0.3, -1.0)
    intensity: float = 1.0
    color: tuple[float, ...] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.direction))
        if not 1e-9 < length < np.inf:
            raise InvalidInputError(f"a lamp shines in no direction: {self.direction} has a length of {length:g}")
        object.__setattr__(self, "direction", tuple(x / length for x in self.direction))


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """One object of a scene.

    Attributes:
        name: Unique name in the scene and identifier in every format, such as ``"teacup_0"``.
        asset: Asset of the object.
        slot: Row of the scene.
        category: Index of the asset in its scene type.
        translation: (3,) float64 m, world frame.
        rotation: (3, 3) float64, asset frame to world frame, orthonormal to machine precision.
        welded: Whether the object is fixed to the world.
        mass: kg.
        inertia: (3, 3) kg m^2 about the centre of mass, asset frame.
        friction: Coefficient of friction.
        color: Factors of red, green and blue, 0 to 1, on the colours of the asset or of its texture.
        texture: One of ``TEXTURES``.
    """

    name: str
    asset: Asset
    slot: int
    category: int
    translation: Array
    rotation: Array
    welded: bool
    mass: float
    inertia: Array
    friction: float
    color: tuple[float, ...] = (1.0, 1.0, 1.0)
    texture: str = "none"

    @property
    def tinted(self) -> bool:
        """Whether the colour is another than the asset's or the texture's."""
        return min(self.color) < 1.0

    @cached_property
    def quaternion(self) -> Array:
        """(4,) float64 unit quaternion (w, x, y, z) with w >= 0."""
        return quaternion(self.rotation)

    @cached_property
    def matrix(self) -> Array:
        """(4, 4) float64, asset frame to world frame."""
        return pose_of(self.translation, self.rotation)

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joints that move while the object stays where it is; none of a free object."""
        return self.asset.joints if self.welded else ()

    @cached_property
    def pieces(self) -> tuple[PlacedObject, ...]:
        """What does not move, at the pose of the object, and then the link of each joint, called ``cabinet_0/door``, at
        its pose in the frame of its parent; the object itself where it has no joints.
        """
        if not self.joints:
            return (self,)
        found = [replace(self, asset=b, mass=b.mass, inertia=b.inertia) for b in self.asset.bodies]
        for row, joint in enumerate(self.joints, start=1):
            place: dict[str, Any] = {"translation": joint.pose[:3, 3], "rotation": joint.pose[:3, :3]}
            found[row] = replace(found[row], name=f"{self.name}/{joint.link}", welded=False, **place)
        return tuple(found)

    @cached_property
    def frames(self) -> list[Array]:
        """(4, 4) of each piece in the frame of the object."""
        found = [np.eye(4)]
        for joint in self.joints:
            found.append(found[joint.parent] @ joint.pose)
        return found


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """One scene.

    Attributes:
        index: Index in the batch.
        scene_type: Scene type of the scene.
        slots: Number of rows of the scene, empty ones included.
        objects: Objects in slot order.
        light: Lamp of the scene.
        own_camera: Camera of the scene in place of that of its type.
    """

    index: int
    scene_type: SceneType
    slots: int
    objects: tuple[PlacedObject, ...]
    light: Light = Light()
    own_camera: Camera | None = None

    @cached_property
    def digest(self) -> bytes:
        """Digest (32 bytes) of the poses."""
        return hashlib.sha256(b"".join(item.matrix.tobytes() for item in self.objects)).digest()

    @property
    def camera(self) -> Camera:
        """The camera of the scene."""
        return self.own_camera or self.scene_type.camera

    @property
    def assets(self) -> tuple[Asset, ...]:
        """The assets in use, each once, in category order."""
        used = {item.category: item.asset for item in self.objects}
        return tuple(used[category] for category in sorted(used))


def place(batch: SceneBatch, friction: float = FRICTION) -> list[PlacedScene]:
    """The scenes of a batch with exact poses, unique names, and the masses of the assets.

    Rotations in single precision become doubles on SO(3) that differ from the given ones by no more than their
    rounding. Objects are named after their asset and numbered in slot order. An asset without mass is welded.

    Raises:
        InvalidInputError: a pose is not finite, or a matrix is not a rotation; the message names its scene and slot.

    >>> from scene_envs.scene import SceneBatch
    >>> scene = place(SceneBatch.empty("dimsum_table", 1))[0]
    >>> [(item.name, item.welded) for item in scene.objects]
    [('cafe_table_0', True)]
    """
    from scene_envs.scene import require_rigid_poses

    batch = batch.to("cpu")
    require_rigid_poses(batch)
    scene_type, library = batch.scene_type, batch.scene_type.library
    names, fixed = identifiers(library.names), scene_type.welded_categories
    translations = batch.translations.double().numpy()
    rotations = exact_rotations(batch.rotations.double().numpy())
    scenes = []
    for index, categories in enumerate(batch.categories.tolist()):
        seen: Counter[int] = Counter()
        objects = []
        for slot, category in enumerate(categories):
            if category == scene_type.num_assets:
                continue
            asset = library[category]
            objects.append(
                PlacedObject(
                    name=f"{names[asset.name]}_{seen[category]}",
                    asset=asset,
                    slot=slot,
                    category=category,
                    translation=translations[index, slot],
                    rotation=rotations[index, slot],
                    welded=category in fixed or asset.static or asset.mass <= 0,
                    mass=asset.mass,
                    inertia=asset.inertia,
                    friction=friction,
                )
            )
            seen[category] += 1
        scenes.append(PlacedScene(index, scene_type, len(categories), tuple(objects)))
    return scenes


def exact_rotations(matrices: NDArray[np.floating]) -> Array:
    """Nearest rotations (..., 3, 3) in double precision, orthonormal to a few 1e-16. The SVD leaves an error of some
    1e-16 per entry; one Newton step of the polar decomposition halves it.
    """
    left, _, right = np.linalg.svd(np.asarray(matrices, dtype=np.float64))
    left[..., -1] *= np.sign(np.linalg.det(left @ right))[..., None]
    rotation: Array = left @ right
    return rotation @ (1.5 * np.eye(3) - 0.5 * rotation.swapaxes(-1, -2) @ rotation)  # type: ignore[no-any-return]


def quaternion(rotation: Array) -> Array:
    """(..., 4) unit quaternions (w, x, y, z), w >= 0, of rotations (..., 3, 3), in double precision."""
    found = np.roll(quaternions(np.asarray(rotation, dtype=np.float64).reshape(-1, 3, 3)), 1, axis=1)
    return (np.copysign(1.0, found[:, :1]) * found).reshape(*np.shape(rotation)[:-2], 4)


def angle_axis(rotation: Array) -> tuple[float, Array]:
    """Angle (degrees, 0..180) and unit axis (3,) of a rotation (3, 3); unlike Euler angles, always well defined.

    >>> angle, axis = angle_axis(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]))
    >>> round(angle, 12), axis.round(12).tolist()
    (90.0, [0.0, 1.0, 0.0])
    """
    vector: Array = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return float(np.degrees(angle)), vector / angle if angle else np.array([0.0, 0.0, 1.0])


def camera_axes(position: Any, target: Any, up: Any) -> Array:
    """(3, 3): columns right, up and backward of a camera at ``position`` (3,) that looks at ``target`` (3,), as OpenGL
    has them; ``up`` (3,).

    >>> camera_axes((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)).round(12).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    return Pinhole.at(position, target, up, 45.0, 1, 1).pose[:3, :3] * [1.0, -1.0, -1.0] + 0.0


def number(value: float) -> str:
    """The shortest text that reads back as exactly this double (17 digits at most).

    >>> number(0.1), number(-0.0), number(1 / 3)
    ('0.1', '0.0', '0.3333333333333333')
    """
    return repr(float(value) + 0.0)


def numbers(values: Sequence[float] | Array) -> str:
    """Several numbers as :func:`number` writes them, separated by spaces."""
    return " ".join(number(value) for value in np.asarray(values, dtype=np.float64).ravel())


class AssetFiles:
    """Writer of asset files; each file is written on first use.

    Args:
        folder: Folder of the assets, ``root``.
        assets: All assets of the export; their unique identifiers are derived from all names together.
        friction: Friction coefficient that formats write into their files.
        package: Name of the whole export, for formats whose paths need one.
    """

    def __init__(self, folder: Path, assets: Sequence[Asset], friction: float, package: str) -> None:
        self.root = folder
        self.friction = friction
        self.package = package
        self._names = identifiers(one.name for many in (assets, *(a.bodies for a in assets)) for one in many)
        self._done: dict[tuple[str, str], Any] = {}

    def name(self, asset: Asset) -> str:
        """The asset's name as an identifier, which is also the name of its folder."""
        return self._names[asset.name]

    def look(self, item: PlacedObject) -> str:
        """Name of an object's asset with its texture: ``teacup``, or ``teacup.checker``."""
        return self.name(item.asset) + ("" if item.texture == "none" else f".{item.texture}")

    def folder(self, asset: Asset) -> Path:
        """Folder of the asset's files."""
        folder = self.root / self.name(asset)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def once(self, asset: Asset, what: str, write: Callable[[Path], Any]) -> Any:
        """The result of ``write(folder)``, called once per asset and ``what``."""
        key = (asset.name, what)
        if key not in self._done:
            self._done[key] = write(self.folder(asset))
        return self._done[key]

    def visual(self, asset: Asset, texture: str = "none") -> Path:
        """``visual.obj`` with normals, its colours in ``visual.png``; one material, ``visual.mtl``. With a texture of
        ``TEXTURES`` the three are ``visual_checker`` and so on.
        """
        name = "visual" if texture == "none" else f"visual_{texture}"
        return self.once(asset, name, lambda folder: _write_visual(textured_mesh(asset, texture), folder / name))

    def parts(self, asset: Asset) -> list[Path]:
        """``part_00.obj`` …, the fine convex parts."""
        return self.once(asset, "part", lambda folder: _write_parts(asset.fine, folder, "part"))

    def inset_parts(self, asset: Asset, inset: float) -> list[Path]:
        """``inset_00.obj`` …, the fine parts with every face moved inward by ``inset`` m, for Bullet."""

        def write(folder: Path) -> list[Path]:
            from scene_envs.physics.parts import PartGeometry, inset_hull

            hulls = [convex_hull(inset_hull(PartGeometry.of(part), inset)) for part in asset.fine]
            return _write_parts(hulls, folder, "inset")

        return self.once(asset, "inset", write)


def visual_mesh(asset: Asset) -> trimesh.Trimesh:
    """The asset's coloured mesh, or its convex parts in the class colour where it has none."""
    mesh: trimesh.Trimesh | None = asset.visual
    if mesh is not None and len(mesh.faces):
        return mesh
    parts = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in asset.fine]
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    joined.visual = trimesh.visual.ColorVisuals(joined, vertex_colors=np.array([*asset.color, 255], dtype=np.uint8))
    return joined


@lru_cache(maxsize=64)
def textured_mesh(asset: Asset, texture: str = "none") -> trimesh.Trimesh:
    """The asset's mesh with one image on a matt material: a palette of its colours, for which corners of several
    colours are split, or the pattern ``texture``.
    """
    from PIL import Image

    mesh = visual_mesh(asset)
    if texture == "none":
        colors, cells = np.unique(_few_colors(face_colors(mesh)), axis=0, return_inverse=True)
        side = int(np.ceil(np.sqrt(len(colors))))
        pixels = np.zeros((side * side, 3), dtype=np.uint8)
        pixels[: len(colors)] = colors
        image = pixels.reshape(side, side, 3).repeat(_CELL, axis=0).repeat(_CELL, axis=1)
        corners = np.stack([mesh.faces, np.repeat(cells.reshape(-1, 1), 3, axis=1)], axis=-1).reshape(-1, 2)
        unique, faces = np.unique(corners, axis=0, return_inverse=True)
        vertices, cell = unique.T
        uv = np.stack([(cell % side + 0.5) / side, 1.0 - (cell // side + 0.5) / side], axis=1)  # v is upward
    else:
        vertices, faces, uv, image = np.arange(len(mesh.vertices)), mesh.faces, pattern_uv(mesh), _pattern(texture)
    material = PBRMaterial(baseColorTexture=Image.fromarray(image), metallicFactor=0.0, roughnessFactor=0.7)
    return trimesh.Trimesh(
        mesh.vertices[vertices],
        faces.reshape(-1, 3),
        vertex_normals=mesh.vertex_normals[vertices],
        visual=trimesh.visual.TextureVisuals(uv=uv, material=material),
        process=False,
    )


def pattern_uv(mesh: trimesh.Trimesh) -> Array:
    """(V, 2) in 0..1: where a pattern lies on a mesh, by an oblique projection, which has no seams; v is upward."""
    x, y, z = np.asarray(mesh.vertices, dtype=np.float64).T
    across = np.stack([x + y, z + 0.5 * (y - x)], axis=1)
    low = across.min(axis=0)
    return (across - low) / np.maximum(np.ptp(across, axis=0), 1e-12)  # type: ignore[no-any-return]


def _pattern(texture: str) -> NDArray[np.uint8]:
    rows, columns = np.indices((_PATTERN, _PATTERN))
    share = {
        "checker": np.where((8 * rows // _PATTERN + 8 * columns // _PATTERN) % 2, 0.4, 1.0),
        "gradient": 1.0 - 0.7 * rows / _PATTERN,
        "flat": np.ones(rows.shape),
    }[texture]
    return np.rint(255.0 * share[..., None].repeat(3, axis=2)).astype(np.uint8)


def linear(colors: Any) -> Array:
    """Colours in 0..1 as formats keep them that light linearly, such as USD and glTF, from those of screens (sRGB)."""
    colors = np.asarray(colors, dtype=np.float64)
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def face_colors(mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """(F, 3) colour of each face; textures are sampled at the corners."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()
        corners = np.asarray(visual.vertex_colors)[mesh.faces]
        return np.round(corners[..., :3].mean(axis=1)).astype(np.uint8)  # type: ignore[no-any-return]
    return np.asarray(visual.face_colors)[:, :3].astype(np.uint8)


def _write_parts(parts: Sequence[ConvexPart], folder: Path, prefix: str) -> list[Path]:
    """Wavefront files of convex parts, in m."""
    paths = []
    for index, part in enumerate(parts):
        lines = [f"v {x:.12g} {y:.12g} {z:.12g}" for x, y, z in (part.vertices + 0.0).tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (part.faces + 1).tolist()]
        paths.append(folder / f"{prefix}_{index:02d}.obj")
        paths[-1].write_text("\n".join(lines) + "\n")
    return paths


def _write_visual(mesh: trimesh.Trimesh, path: Path) -> Path:
    """The mesh with its image: most loaders read textures, and few read colours of vertices."""
    shown, white = mesh.copy(), [255, 255, 255, 255]
    visual: Any = shown.visual
    material = SimpleMaterial(visual.material.baseColorTexture, white, white, [0, 0, 0, 255], name=path.name)
    shown.visual = trimesh.visual.TextureVisuals(visual.uv, material)
    mtl = f"{path.name}.mtl"
    text, others = export_obj(shown, include_normals=True, return_texture=True, mtl_name=mtl, header=None, digits=7)
    for name, data in {**others, f"{path.name}.obj": text.encode()}.items():
        path.with_name(name).write_bytes(data)
    return path.with_suffix(".obj")


def _few_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The colours, rounded to the largest number of bits per channel with which they fit into the palette."""
    for bits in range(8, 2, -1):
        step = 1 << (8 - bits)
        rounded = np.minimum(colors.astype(np.int64) // step * step + step // 2, 255).astype(np.uint8)
        if len(np.unique(rounded, axis=0)) <= _MAX_COLORS:
            break
    return rounded
