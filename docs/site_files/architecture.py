"""Drawing of the subpackages and of one sample's way through them: ``python docs/site_files/architecture.py``."""

from __future__ import annotations

from html import escape
from itertools import pairwise
from pathlib import Path

FILE = Path(__file__).parents[1] / "images" / "architecture.svg"

ROWS: tuple[dict[str, tuple[int, str]], ...] = (
    {
        "scene_envs.assets": (0, "meshes, convex parts, masses"),
        "agents.utils": (4, "shared helpers"),
    },
    {"scene_envs.scene_types": (0, "assets, workspace, camera")},
    {"scene_envs.scene": (0, "SceneBatch, normalizer")},
    {
        "scene_envs.physics": (0, "overlap, settling, projection"),
        "scene_envs.render": (1, "pictures, sensors, viewer"),
        "agents.diffusion": (3, "forward and reverse processes"),
    },
    {"scene_envs.grammars": (0, "structures and exact poses"), "scene_envs.export": (1, "files for simulators")},
    {"scene_envs.datasets": (0, "verified scenes, prompts")},
    {"scene_envs.envs": (1, "denoising and search")},
    {"rewards": (2, "scores of scenes")},
    {"agents.configuration": (4, "keys, their values by Hydra")},
    {"agents.planning": (3, "planners, search runs"), "agents.evaluation": (4, "measures of scenes")},
    {"agents.networks": (3, "denoisers, text encoders")},
    {"agents.priors": (3, "sample, inpaint, save")},
    {"agents.pretraining": (3, "training of priors")},
    {"agents.post_training": (3, "steering of priors")},
    {"agents.cli": (3, "scene-envs COMMAND")},
)
"""Subpackages by row, with their column and what they hold. A subpackage imports those of higher rows alone."""

WAY = ("scene_envs.grammars", "scene_envs.datasets", "agents.pretraining", "agents.post_training", "agents.cli")
"""Subpackages that hold one sample, in order; each imports the one before it."""

CALLS = (
    ("scene_envs.datasets", "scene_envs.physics"),
    ("agents.pretraining", "agents.priors"),
    ("agents.post_training", "scene_envs.envs"),
    ("agents.post_training", "rewards"),
    ("agents.post_training", "agents.evaluation"),
)
"""Calls on the way of the sample: the first imports and calls the second."""

_WIDTH, _HEIGHT, _LEFT, _TOP = 186, 44, 20, 56
_STEP_X, _STEP_Y = 200, 68
_COLUMNS = (("scene_envs", 0, 2), ("rewards", 2, 1), ("agents", 3, 2))


def corner(room: str) -> tuple[int, int]:
    """Left upper corner of a subpackage's box, pixels."""
    row = next(index for index, rooms in enumerate(ROWS) if room in rooms)
    return _LEFT + ROWS[row][room][0] * _STEP_X, _TOP + row * _STEP_Y


def drawing() -> str:
    """The whole drawing as SVG."""
    width, height = 2 * _LEFT + 5 * _STEP_X - 14, _TOP + len(ROWS) * _STEP_Y + 56
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif">',
        "<defs>" + _head("way", "#00796b") + _head("calls", "#8a8f98") + "</defs>",
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
    ]
    for name, column, count in _COLUMNS:
        x, wide = _LEFT - 8 + column * _STEP_X, count * _STEP_X - 4
        parts += [
            f'<rect x="{x}" y="14" width="{wide}" height="{height - 70}" rx="10" fill="#f3f5f6"/>',
            f'<text x="{x + 12}" y="38" font-size="16" font-weight="bold" fill="#3a3e46">{name}</text>',
        ]
    parts += [_call(*pair) for pair in CALLS]
    parts += [_way(first, second) for first, second in pairwise(WAY)]
    for rooms in ROWS:
        parts += [_box(room, text) for room, (_, text) in rooms.items()]
    legend = height - 26
    parts += [
        f'<path d="M20 {legend} h40" stroke="#00796b" stroke-width="3" marker-end="url(#way)"/>',
        f'<text x="74" y="{legend + 4}" font-size="13" fill="#3a3e46">path of one sample</text>',
        f'<path d="M330 {legend} h40" stroke="#8a8f98" stroke-dasharray="5 4" marker-end="url(#calls)"/>',
        f'<text x="384" y="{legend + 4}" font-size="13" fill="#3a3e46">calls on the path</text>',
        f'<text x="540" y="{legend + 4}" font-size="13" fill="#3a3e46">',
        "A subpackage imports only subpackages of higher rows.</text>",
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _head(name: str, color: str) -> str:
    return (
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto" '
        f'markerUnits="userSpaceOnUse"><path d="M0 0L8 4L0 8z" fill="{color}"/></marker>'
    )


def _box(room: str, text: str) -> str:
    x, y = corner(room)
    edge, stroke = ("#00796b", 2.5) if room in WAY else ("#b9bec6", 1)
    name = room.partition(".")[2] or room
    return (
        f'<rect x="{x}" y="{y}" width="{_WIDTH}" height="{_HEIGHT}" rx="6" fill="#ffffff" stroke="{edge}" '
        f'stroke-width="{stroke}"/><text x="{x + 10}" y="{y + 18}" font-size="14" font-weight="bold" fill="#20242a">'
        f'{escape(name)}</text><text x="{x + 10}" y="{y + 35}" font-size="12" fill="#5a606a">{escape(text)}</text>'
    )


def _way(first: str, second: str) -> str:
    (x0, y0), (x1, y1) = corner(first), corner(second)
    start, end = (x0 + _WIDTH // 2, y0 + _HEIGHT), (x1 + _WIDTH // 2, y1)
    if x0 != x1:  # out at the foot of one box, down, into the side of the other
        end = (x1, y1 + _HEIGHT // 2)
        return _path(f"M{start[0]} {start[1]} V{end[1]} H{end[0]}", "way")
    return _path(f"M{start[0]} {start[1]} V{end[1]}", "way")


def _call(first: str, second: str) -> str:
    (x0, y0), (x1, y1) = corner(first), corner(second)
    if x0 == x1:  # beside the boxes, along their left or right side
        side, out = (x0 + _WIDTH, 10) if first.startswith("agents") else (x0 + _WIDTH, 8)
        return _path(f"M{side} {y0 + 22} h{out} V{y1 + 22} H{side}", "calls")
    target = (x1 + _WIDTH // 2, y1 + _HEIGHT)
    start = (x0, y0 + 14) if x1 < x0 else (x0 + _WIDTH, y0 + 14)
    return _path(f"M{start[0]} {start[1]} H{target[0]} V{target[1]}", "calls")


def _path(line: str, kind: str) -> str:
    style = 'stroke="#00796b" stroke-width="3"' if kind == "way" else 'stroke="#8a8f98" stroke-dasharray="5 4"'
    return f'<path d="{line}" fill="none" {style} marker-end="url(#{kind})"/>'


if __name__ == "__main__":
    FILE.write_text(drawing(), encoding="utf-8")
