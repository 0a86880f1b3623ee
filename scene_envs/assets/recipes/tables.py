"""Built-in assets, whose shapes are a table, ``tables.json``.

An entry holds the facts of :func:`~scene_envs.assets.base.asset_recipe` and rows of shapes. The first key of a row
names a function of :mod:`scene_envs.assets.shapes` or of :mod:`scene_envs.assets.recipes.painted` and gives its first
argument, the others are keywords; ``at`` lists the places (x, y, z) m of a box, or of a mesh that ``turn`` (3, 3)
rotates. ``coarse`` holds numbers of rows, for their parts, and lists of such numbers, for hulls of them; without it,
the coarse parts are the fine ones. Colours are ``#rrggbb``, lengths m, angles rad.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import trimesh

from scene_envs.assets.base import ConvexPart, Model, asset_recipe
from scene_envs.assets.recipes.painted import bar, barrel, beam, printed, prism, revolve, scoop, slabs, sleeve
from scene_envs.assets.shapes import (
    FACES,
    Patch,
    box,
    convex_hull,
    hull_of,
    join,
    lathe,
    lettering,
    moved,
    painted_box,
    planks,
    ring,
    rods,
    sheet,
    solid,
    tiles,
    tube,
)

_PARTS = {"box": box, "hull": convex_hull, "solid": solid, "ring": ring, "rods": rods, "beam": beam}
_PATCHES: dict[str, Any] = {"lettering": lettering, "tiles": tiles}


def _painted(size: Any, color: Any, art: Any = None, **rest: Any) -> trimesh.Trimesh:
    """A painted box; ``sides`` are the four faces around it."""
    colors: Any = {face: color.get(face, color.get("sides")) for face in FACES} if isinstance(color, dict) else color
    drawn = {face: art.get(face, art.get("sides", ()) if face in FACES[:4] else ()) for face in FACES} if art else {}
    patches: Any = {
        face: [patch for row in rows for patch in (_PATCHES[row[0]](*row[1:]) if row[0] in _PATCHES else [Patch(*row)])]
        for face, rows in drawn.items()
    }
    return painted_box(size, colors, patches, **rest)


_LOOKS: dict[str, Any] = {
    "painted_box": _painted, "lathe": lathe, "tube": tube, "planks": planks, "sheet": sheet, "revolve": revolve,
    "sleeve": sleeve, "slabs": slabs, "print": printed, "bar": bar, "scoop": scoop, "prism": prism, "barrel": barrel,
}  # fmt: skip


def _decoded(value: Any) -> Any:
    """The value with its colours as (r, g, b) and lists as tuples."""
    if isinstance(value, str) and value.startswith("#"):
        return tuple(bytes.fromhex(value[1:]))
    if isinstance(value, dict):
        return {key: _decoded(item) for key, item in value.items()}
    return tuple(map(_decoded, value)) if isinstance(value, list) else value


def _made(row: dict[str, Any], makers: dict[str, Any]) -> list[Any]:
    """What a row makes, at each of its places."""
    (name, first), *rest = _decoded(row).items()
    options = dict(rest)
    places, turn = options.pop("at", ()), options.pop("turn", None)
    if turn is not None:
        return [moved(makers[name](first, **options), turn, place) for place in places]
    bases = [{"base": place} for place in places] or [{}]
    found = [makers[name](first, **options, **base) for base in bases]
    return found[0] if isinstance(found[0], list) else found


def _model(entry: dict[str, Any]) -> Model:
    """The model of an entry of the table."""
    rows: list[list[ConvexPart]] = [_made(row, _PARTS) for row in entry["parts"]]
    visual = join(*(mesh for row in entry["visual"] for mesh in _made(row, _LOOKS)))
    fine = [part for row in rows for part in row]
    coarse = [
        part
        for group in entry.get("coarse", range(len(rows)))
        for part in (rows[group] if isinstance(group, int) else [hull_of(part for at in group for part in rows[at])])
    ]
    return Model(visual, fine, coarse)


for _name, _entry in json.loads(Path(__file__).with_suffix(".json").read_text("utf-8")).items():
    _facts = {key: _decoded(_entry[key]) for key in ("display_name", "plural", "mass", "color") if key in _entry}
    asset_recipe(_name, **_facts)(partial(_model, _entry))
