"""Viewer: one self-contained HTML file that shows scenes in a browser."""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.assets import Asset, ConvexPart
from scene_envs.errors import InvalidInputError
from scene_envs.files import page_part, page_template, write_text
from scene_envs.render.stage import frame_scene_type, vertex_colors
from scene_envs.rotations import matrix_to_quaternion
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

_WEB = "scene_envs.render.web"
_SCRIPTS = ("math.js", "decode.js", "shaders.js", "targets.js", "renderer.js", "controls.js", "app.js")
_FOV = 28.0
_STEPS = 65535
"""Largest coordinate of vertices, which are whole numbers in the bounding box of their mesh."""
_CONTACT, _TABLE = 0.05, 0.68
"""Reach (m) of contact shading, ``_CONTACT``, in a framing of radius ``_TABLE`` (m)."""


def write_viewer(
    batch: SceneBatch, path: str | os.PathLike[str], *, captions: Sequence[str] | None = None, title: str | None = None
) -> Path:
    """Write scenes as one HTML file that any browser with WebGL 2 draws, without a network; returns its path.

    The geometry of each used asset is embedded once, and scenes are embedded as poses. An address that ends with
    ``#scene=3&azimuth=-60&elevation=30`` opens a scene (counted from 0) from a direction (degrees); the page keeps its
    address up to date.

    Args:
        batch: B scenes, at least one.
        path: File to write; its folder is made.
        captions: One line per scene; the number of objects by default.
        title: Heading of the page; the name of the scene type by default.

    Raises:
        InvalidInputError: no scenes, or another number of captions.
    """
    write_text(path, viewer_page(batch, captions=captions, title=title))
    return Path(path)


def viewer_page(batch: SceneBatch, *, captions: Sequence[str] | None = None, title: str | None = None) -> str:
    """The page of :func:`write_viewer` as text.

    A page that shows it in a frame can call ``sceneViewer.showScene(k)`` of the frame's window to show scene k.
    """
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup

    if len(batch) == 0:
        raise InvalidInputError("a viewer needs at least one scene; the batch is empty")
    if captions is None:
        captions = [f"{count} object{'s' if count != 1 else ''}" for count in batch.counts.tolist()]
    if len(captions) != len(batch):
        raise InvalidInputError(f"{len(batch)} scenes need {len(batch)} captions, got {len(captions)}")
    title = batch.scene_type.name.replace("_", " ") if title is None else title
    return page_template(_WEB, "viewer.html").render(
        title=title,
        style=Markup(page_part(_WEB, "viewer.css")),
        scripts=Markup("\n".join(page_part(_WEB, name) for name in _SCRIPTS)),
        # escaped, so that it cannot end the HTML element that holds it
        data=htmlsafe_json_dumps(_viewer_data(batch, captions), separators=(",", ":"), allow_nan=False),
    )


def _viewer_data(batch: SceneBatch, captions: Sequence[str]) -> dict[str, Any]:
    """Data of the page: assets in use, scenes and the view."""
    scene_type = batch.scene_type
    categories = batch.categories.cpu().numpy()
    used = np.unique(categories[categories < scene_type.num_assets])
    index_of = np.zeros(scene_type.num_assets + 1, dtype=np.uint16)
    index_of[used] = np.arange(len(used))
    rotations = torch.where(batch.is_empty[..., None, None], torch.eye(3).to(batch.rotations), batch.rotations)
    quaternions = matrix_to_quaternion(rotations.detach().cpu().double()).float()
    poses = torch.cat([batch.translations.detach().cpu(), quaternions], dim=-1).numpy()  # (B, N, 7)
    scenes = []
    for row, pose, caption in zip(categories, poses, captions, strict=True):
        (slots,) = np.nonzero(row < scene_type.num_assets)
        scenes.append(
            {
                "caption": str(caption),
                "assets": _text(index_of[row[slots]]),
                "slots": _text(slots.astype(np.uint16)),
                "poses": _text(pose[slots].astype(np.float32)),
            }
        )
    library = scene_type.library
    assets = [_asset(library[int(c)], library[int(c)].name in scene_type.welded) for c in used]
    return {"assets": assets, "scenes": scenes, "view": _view(scene_type)}


def _asset(asset: Asset, welded: bool) -> dict[str, Any]:
    mesh = asset.visual
    small = len(mesh.vertices) <= _STEPS
    return {
        "name": asset.name,
        "label": asset.display_name,
        "color": list(asset.color),
        "welded": welded,
        "visual": {
            **_positions(np.asarray(mesh.vertices)),
            "normal": _text(np.rint(127.0 * np.asarray(mesh.vertex_normals)).astype(np.int8)),
            "color": _text(vertex_colors(asset)),
            "index": _text(np.asarray(mesh.faces).astype(np.uint16 if small else np.uint32)),
        },
        "fine": _parts(asset.fine),
        "coarse": _parts(asset.coarse),
    }


def _parts(parts: Sequence[ConvexPart]) -> dict[str, Any]:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    if starts[-1] > _STEPS:
        raise InvalidInputError(f"convex parts with {starts[-1]} vertices; the viewer shows up to {_STEPS} per asset")
    return {
        **_positions(np.concatenate([part.vertices for part in parts])),
        "index": _text(faces.astype(np.uint16)),
        "faces": [len(part.faces) for part in parts],
    }


def _positions(vertices: NDArray[np.float64]) -> dict[str, Any]:
    """Vertices quantised to their bounding box: in steps of 4 um in a steamer, and 0.15 mm in a floor of 10 m."""
    low = vertices.min(axis=0)
    size = np.maximum(vertices.max(axis=0) - low, 1e-9)
    steps = np.rint((vertices - low) / size * _STEPS).astype(np.uint16)
    return {"low": low.tolist(), "size": size.tolist(), "position": _text(steps)}


def _view(scene_type: SceneType) -> dict[str, Any]:
    framing = frame_scene_type(scene_type)
    x, y, z = framing.to_camera.tolist()
    return {
        "points": _outermost(framing.points).round(4).tolist(),
        "azimuth": float(np.degrees(np.arctan2(y, x))),
        "elevation": float(np.degrees(np.arcsin(z))),
        "workspace": [list(corner) for corner in scene_type.workspace],
        "fov": _FOV,
        "light": framing.to_light.tolist(),
        "center": framing.center.tolist(),
        "radius": framing.radius,
        "ground": framing.ground,
        "contact": float(_CONTACT * np.sqrt(framing.radius / _TABLE)),
    }


def _outermost(points: NDArray[np.float64], directions: int = 200) -> NDArray[np.float64]:
    """The points that are farthest in at least one of many directions; these are enough to fit a view to."""
    step = np.arange(directions) + 0.5
    z, angle = 1.0 - 2.0 * step / directions, step * np.pi * (3.0 - np.sqrt(5.0))
    r = np.sqrt(1.0 - z**2)
    sphere = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    return points[np.unique((points @ sphere.T).argmax(axis=0))]


def _text(values: NDArray[Any]) -> str:
    """The values as little-endian bytes in base64."""
    little = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    return base64.b64encode(little.tobytes()).decode("ascii")
