"""HTML page of a search tree: all scenes by value, pictures of the best ones, and the best path in 3-D."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.planning.tree_file import SearchRecord, TreeNode
from scene_envs.files import finite, write_text
from scene_envs.pages import page_part, page_template
from scene_envs.scene import SceneBatch

MAX_PATH_SCENES = 60
"""Largest number of scenes of the best path that are shown; some steps of a longer path are left out."""
MAX_OTHER_SCENES = 24
"""Largest number of other scenes that are shown, the best ones."""


@dataclass(frozen=True)
class Card:
    """A scene in the drawing of the best scenes and their ancestors.

    Attributes:
        node: node of the scene.
        column: depth of the node; the first samples, or the scene that the search started from, have depth 0.
        row: row of the card, counted from 0; a first child is in the row of its parent.
        parent: index of the parent's card; None for a first sample.
        number: number of the scene in its search, counted from 1.
        frame: index of the scene in the 3-D view, which draws its picture; None without one.
        on_path: whether it leads to the best scene.
    """

    node: TreeNode
    column: int
    row: int
    parent: int | None
    number: int
    frame: int | None
    on_path: bool


def best_path(record: SearchRecord) -> list[int]:
    """Ids of the scenes that lead to the best one, from a first sample or the scene that the search started from."""
    return record.path(record.searches[0]["best"])[_first(record) :]


def _first(record: SearchRecord) -> int:
    """Index of the first shown scene of a path: 1 if the root is an empty scene, 0 if the search started from it."""
    return 0 if record.settings.get("from_scene") else 1


def shown_nodes(record: SearchRecord) -> list[int]:
    """Ids of the scenes that the page shows: the best path of the first search, then its other best scenes."""
    path = best_path(record)
    if len(path) > MAX_PATH_SCENES:
        path = [path[step] for step in np.linspace(0, len(path) - 1, MAX_PATH_SCENES).round().astype(int)]
    on_path = set(path)
    others = [node for node in record.tree_of(0)[1:] if node.value is not None and node.id not in on_path]
    best = heapq.nsmallest(MAX_OTHER_SCENES, others, key=lambda node: (-(node.value or 0.0), node.id))
    return path + [node.id for node in best]


def write_tree_page(
    path: Path,
    record: SearchRecord,
    scenes: Mapping[int, SceneBatch],
    metrics: Mapping[str, Any],
    *,
    returned: SceneBatch | None = None,
) -> Path:
    """Write the page of the first search of ``record``, which works offline and without other files.

    Args:
        path: HTML file to write.
        record: record of all scenes.
        scenes: a batch of one for each id of :func:`shown_nodes`.
        metrics: contents of ``metrics.json``.
        returned: scene that the search returned, if it is not a node because the planner changed it at the end.
    """
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup

    from scene_envs.render import viewer_page

    shown = list(scenes)
    way = best_path(record)
    batch = SceneBatch.concatenate([*scenes.values(), *([] if returned is None else [returned])])
    tree = record.tree_of(0)
    number = {node.id: k for k, node in enumerate(tree)}
    captions = [_caption(record.nodes[node], number, way) for node in shown]
    if returned is not None:
        captions.append("the scene that the search returned")
    cards = _cards(record, shown, way)
    on_path = set(way)
    steps = [k for k, node in enumerate(shown) if node in on_path] + ([] if returned is None else [len(shown)])
    data = {
        "parent": [-1 if node.parent is None else number[node.parent] for node in tree],
        "objective": [node.objective for node in tree],
        "action": [node.action for node in tree],
        "depth": [node.depth for node in tree],
        "below": [node.visits for node in tree],
        "redo": [len(node.mask) for node in tree],
        "masks": [record.nodes[node].mask for node in shown],
        "frame": {number[node]: frame for frame, node in enumerate(shown)},
        "path": [number[node] for node in way],
        "steps": steps,
        "name": _words(metrics["objective"]),
        "baseline": _baseline(metrics),
        "nfe": record.settings["nfe_per_scene"],
        "from_scene": not _first(record),
    }
    style = "".join(page_part(*place) for place in (("agents.utils", "report.css"), ("agents.planning", "tree.css")))
    page = page_template("agents.planning", "tree.html", trim_blocks=True).render(
        style=Markup(style),
        script=Markup(page_part("agents.planning", "tree.js")),
        data=htmlsafe_json_dumps(finite(data), separators=(",", ":"), allow_nan=False),
        viewer=viewer_page(batch, captions=captions, title="The best scenes"),
        cards=cards,
        columns=1 + max(card.column for card in cards),
        rows=1 + max(card.row for card in cards),
        record=record,
        metrics=metrics,
        objective=_words(metrics["objective"]),
        path_length=record.nodes[record.searches[0]["best"]].depth,
        from_scene=not _first(record),
        left_out=sum(node not in scenes for node in way),
        best_nodes=sum(node not in on_path for node in shown),
        scene_type=_words(batch.scene_type.name),
    )
    write_text(path, page)
    return path


def _cards(record: SearchRecord, shown: Sequence[int], way: Sequence[int]) -> list[Card]:
    """The cards of the shown scenes and of all their ancestors except an empty root, parents first.

    The best path is in the first row. A chain of first children takes the highest row that is free in all its columns.
    """
    frames, on_path = {node: frame for frame, node in enumerate(shown)}, set(way)
    number = {node.id: k for k, node in enumerate(record.tree_of(0))}
    children: dict[int | None, list[int]] = {}
    for each in {ancestor for node in shown for ancestor in record.path(node)[_first(record) :]}:
        children.setdefault(record.nodes[each].parent, []).append(each)
    for siblings in children.values():
        siblings.sort(key=lambda each: (each not in on_path, -(record.nodes[each].value or 0.0), each))
    cards: list[Card] = []
    index: dict[int, int] = {}
    used: dict[int, int] = {}
    chains = deque(children.get(record.searches[0]["root"] if _first(record) else None, []))
    while chains:
        chain = [record.nodes[chains.popleft()]]
        while below := children.get(chain[-1].id):
            chain.append(record.nodes[below[0]])
        first = 0 if chain[0].parent not in index else cards[index[chain[0].parent]].column + 1
        row = max(used.get(column, 0) for column in range(first, first + len(chain)))
        for column, node in enumerate(chain, start=first):
            used[column], parent = row + 1, None if node.parent is None else index.get(node.parent)
            index[node.id] = len(cards)
            cards.append(Card(node, column, row, parent, number[node.id], frames.get(node.id), node.id in on_path))
            chains.extend(children.get(node.id, [])[1:])
    return cards


def _caption(node: TreeNode, number: Mapping[int, int], way: Sequence[int]) -> str:
    place = f"step {way.index(node.id) + 1} of {len(way)} to the best" if node.id in way else "another good scene"
    made = "where the search started" if node.parent is None else f"made as no. {number[node.id]}"
    objective = "not scored" if node.objective is None else f"objective {node.objective:.4g}"
    return f"{place} · {made} · {objective} · {len(node.mask)} slots to redo"


def _baseline(metrics: Mapping[str, Any]) -> list[float | None]:
    """Best objective of the independent samples after each of them; empty without a baseline."""
    scale = metrics["objective_scale"]
    curve = metrics.get("best_of", {}).get("curve", [])
    return [None if value is None else scale * value for value in curve]


def _words(name: object) -> str:
    return str(name).replace("_", " ")
