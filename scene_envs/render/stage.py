"""Stage: one PyBullet client that holds the bodies of a library and draws what a camera sees."""

from __future__ import annotations

import atexit
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_envs.assets import Asset, get_library
from scene_envs.scene_types import Camera
from scene_envs.silence import quiet_pybullet

_AWAY = (0.0, 0.0, -1000.0)
_CELL, _CELLS = 8, 32
"""The palette texture: 32 x 32 cells of 8 pixels, one per colour."""


@dataclass(frozen=True)
class Frame:
    """Images of one camera."""

    color: NDArray[np.float32]  # (H, W, 3) float32 in 0..255, lit but without shadows
    depth: NDArray[np.float32]  # (H, W) float32, distance along the viewing direction, m; inf without an object
    slots: NDArray[np.int64]  # (H, W) int64, slot of the visible object; -1 without one
    view: NDArray[np.float64]  # (4, 4) transform from world to camera (x right, y up, z backward)
    focal: NDArray[np.float64]  # (2,) focal lengths, in half image widths and heights


def load_pybullet() -> ModuleType:
    """The PyBullet module; raises MissingDependencyError where it is not installed."""
    return quiet_pybullet(
        "pictures need PyBullet, which is not installed; install it with `pip install pybullet` "
        "(its wheels exist for Python 3.10 and 3.11)"
    )


class Stage:
    """Bodies of the assets ``names``, in category order, made on first use; pictures only change their poses."""

    def __init__(self, names: tuple[str, ...], folders: tuple[str, ...] = ()) -> None:
        self._bullet = load_pybullet()
        self._client: int = self._bullet.connect(self._bullet.DIRECT)
        self._library = get_library(names, folders)
        self._palette, self._texture = self._load_palette()
        self._shapes: dict[int, int] = {}
        self._bodies: list[list[int]] = [[] for _ in names]
        atexit.register(self.close)

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if self._client >= 0 and self._bullet.isConnected(self._client):
            self._bullet.disconnect(self._client)
        self._client = -1

    def place(
        self, translations: NDArray[np.float64], quaternions: NDArray[np.float64], categories: NDArray[np.int64]
    ) -> None:
        """Move bodies to the objects of one scene, and all others out of sight.

        Args:
            translations: (N, 3) translations, m.
            quaternions: (N, 4) quaternions (w, x, y, z).
            categories: (N,) categories; indices outside the library are empty slots.
        """
        bullet, used = self._bullet, [0] * len(self._bodies)
        highest = max((body for bodies in self._bodies for body in bodies), default=-1)
        slot_of = np.full(highest + 1 + len(categories), -1, dtype=np.int64)
        for slot, category in enumerate(categories.tolist()):
            if not 0 <= category < len(self._bodies):
                continue
            bodies = self._bodies[category]
            if used[category] == len(bodies):
                bodies.append(self._add_body(category))
            body = bodies[used[category]]
            used[category] += 1
            w, x, y, z = quaternions[slot].tolist()
            bullet.resetBasePositionAndOrientation(
                body, translations[slot].tolist(), (x, y, z, w), physicsClientId=self._client
            )
            slot_of[body] = slot
        for bodies, count in zip(self._bodies, used, strict=True):
            for body in bodies[count:]:
                bullet.resetBasePositionAndOrientation(body, _AWAY, (0, 0, 0, 1), physicsClientId=self._client)
        self._slot_of = slot_of

    def look(self, camera: Camera, width: int, height: int, light: Sequence[float] = (0.3, -0.4, 1.0)) -> Frame:
        """Draw the placed objects, ``width`` x ``height`` pixels, lit from direction ``light``."""
        bullet = self._bullet
        distance = float(np.linalg.norm(np.subtract(camera.position, camera.target)))
        near, far = 0.1 * distance, 10.0 * distance
        view = bullet.computeViewMatrix(camera.position, camera.target, camera.up)
        projection = bullet.computeProjectionMatrixFOV(camera.fov_y, width / height, near, far)
        _, _, rgba, depth, bodies = bullet.getCameraImage(
            width, height, view, projection, renderer=bullet.ER_TINY_RENDERER, shadow=0, lightDirection=light,
            lightColor=(1, 1, 1), lightAmbientCoeff=0.70, lightDiffuseCoeff=0.36, lightSpecularCoeff=0.05,
            physicsClientId=self._client,
        )  # fmt: skip
        color = np.reshape(np.asarray(rgba), (height, width, 4))[..., :3].astype(np.float32)
        raw = np.reshape(np.asarray(depth, dtype=np.float64), (height, width))
        body = np.reshape(np.asarray(bodies, dtype=np.int64), (height, width))
        slots = np.where(body >= 0, self._slot_of[np.maximum(body, 0)], -1)
        metres = np.where(slots >= 0, far * near / (far - (far - near) * raw), np.inf)
        matrix = np.asarray(projection).reshape(4, 4)
        return Frame(
            color,
            metres.astype(np.float32),
            slots,
            np.asarray(view, dtype=np.float64).reshape(4, 4).T,
            np.array([matrix[0, 0], matrix[1, 1]]),
        )

    def _load_palette(self) -> tuple[NDArray[np.int64], int]:
        """All colours of the library in one texture, because TinyRenderer draws no vertex colours."""
        from PIL import Image

        palette, self._mask = make_palette(np.concatenate([_color_codes(asset) for asset in self._library]), _CELLS**2)
        codes = np.zeros(_CELLS**2, dtype=np.int64)
        codes[: len(palette)] = palette
        rgb = np.stack([codes >> 16, (codes >> 8) & 255, codes & 255], axis=-1).astype(np.uint8)
        pixels = rgb.reshape(_CELLS, _CELLS, 3).repeat(_CELL, axis=0).repeat(_CELL, axis=1)
        handle, path = tempfile.mkstemp(suffix=".png")
        os.close(handle)
        try:
            Image.fromarray(pixels).save(path)
            texture: int = self._bullet.loadTexture(path, physicsClientId=self._client)
        finally:
            Path(path).unlink()
        return palette, texture

    def _add_body(self, category: int) -> int:
        if category not in self._shapes:
            self._shapes[category] = self._add_shape(self._library[category])
        body: int = self._bullet.createMultiBody(
            baseMass=0.0, baseVisualShapeIndex=self._shapes[category], physicsClientId=self._client
        )
        self._bullet.changeVisualShape(body, -1, textureUniqueId=self._texture, physicsClientId=self._client)
        return body

    def _add_shape(self, asset: Asset) -> int:
        cells = np.searchsorted(self._palette, _color_codes(asset) & self._mask)
        uv = np.stack([(cells % _CELLS + 0.5) / _CELLS, 1.0 - (cells // _CELLS + 0.5) / _CELLS], axis=1)
        gloss = 0.0 if asset.static else 0.35
        return self._bullet.createVisualShape(
            self._bullet.GEOM_MESH,
            vertices=asset.visual.vertices.tolist(),
            indices=asset.visual.faces.ravel().tolist(),
            normals=asset.visual.vertex_normals.tolist(),
            uvs=uv.tolist(),
            rgbaColor=(1, 1, 1, 1),
            specularColor=(gloss, gloss, gloss),
            physicsClientId=self._client,
        )


@cache
def get_stage(names: tuple[str, ...], folders: tuple[str, ...] = ()) -> Stage:
    """The stage of this process for the assets ``names``, which are looked up in ``folders`` first."""
    return Stage(names, folders)


def make_palette(codes: NDArray[np.int64], limit: int) -> tuple[NDArray[np.int64], int]:
    """At most ``limit`` colours (0xRRGGBB, sorted) that replace ``codes``, and the mask of the bits they keep.

    Colours are exact as long as they fit. If there are more (in scans), the lowest bits of each channel are dropped.
    """
    for bits in range(8, 0, -1):
        channel = (0xFF << (8 - bits)) & 0xFF
        mask = channel << 16 | channel << 8 | channel
        palette = np.unique(codes & mask)
        if len(palette) <= limit:
            break
    return palette, mask


def vertex_colors(asset: Asset) -> NDArray[np.uint8]:
    """(V, 3): the colour of each vertex of the visual mesh; the class colour where the mesh has none."""
    visual: Any = asset.visual.visual
    if getattr(visual, "kind", None) == "texture":
        visual = visual.to_color()
    if getattr(visual, "kind", None) is None:
        return np.tile(np.array(asset.color, dtype=np.uint8), (len(asset.visual.vertices), 1))
    return np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)


def _color_codes(asset: Asset) -> NDArray[np.int64]:
    rgb = vertex_colors(asset).astype(np.int64)
    return (rgb[:, 0] << 16) | (rgb[:, 1] << 8) | rgb[:, 2]
