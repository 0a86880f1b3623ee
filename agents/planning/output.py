"""Output of a search: every scene in ``tree.json``, figures, pictures, and the page ``tree.html``."""

from __future__ import annotations

import heapq
import itertools
import json
import math
import os
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from agents.planning.ledger import PlanResult
from scene_envs.envs import SearchState
from scene_envs.errors import CorruptFileError
from scene_envs.files import finite, page_part, page_template, with_digest, without_digest, write_json, write_text
from scene_envs.scene import SceneBatch

MAX_PATH_SCENES = 60
"""Largest number of scenes of the best path that are shown; some steps of a longer path are left out."""
MAX_OTHER_SCENES = 24
"""Largest number of other scenes that are shown, the best ones."""

_FORMAT = "scene-envs search tree 1"


@dataclass(frozen=True)
class TreeNode:
    """One scene of a search.

    Attributes:
        id: index in the list of nodes; roots first, then in the order of expansion.
        parent: id of the node from which it was inpainted; None for a root.
        action: index among the children of its parent; None for a root.
        depth: number of inpaintings since the root.
        value: Φ in [0, 1]; None if the objective could not score the scene.
        objective: raw objective; None if the scene could not be scored.
        visits: number of scored scenes at and below this node.
        nfe: denoiser evaluations of all searches of the run up to and including this scene.
        mask: slots that its children regenerate.
    """

    id: int
    parent: int | None
    action: int | None
    depth: int
    value: float | None
    objective: float | None
    visits: int
    nfe: int
    mask: tuple[int, ...]


@dataclass(frozen=True)
class SearchRecord:
    """Trees of a search run with any planner, the content of ``tree.json``.

    Attributes:
        settings: ``planner``, ``objective``, ``objective_scale`` (objective at Φ = 1) and ``nfe_per_scene``.
        searches: one mapping per search, the best first: ``seed``, ``root`` and ``best`` (ids).
        nodes: nodes of all searches.

    >>> node = TreeNode(0, None, None, 0, 0.5, 2.0, 1, 0, (1, 2))
    >>> record = SearchRecord({"planner": "greedy"}, [{"seed": 0, "root": 0, "best": 0}], [node])
    >>> record.path(0)
    [0]
    """

    settings: Mapping[str, Any]
    searches: Sequence[Mapping[str, int]]
    nodes: Sequence[TreeNode]

    @classmethod
    def of(
        cls,
        roots: Sequence[SearchState],
        states: Iterable[SearchState],
        best: Mapping[int, tuple[int, ...]],
        settings: Mapping[str, Any],
    ) -> SearchRecord:
        """The record of searches that started from ``roots``, which have a seed each. ``states`` are all expanded ones,
        in order; ``best`` has the path of the best state by seed, the best search first.
        """
        rows: list[dict[str, Any]] = []
        ids: dict[tuple[int, tuple[int, ...]], int] = {}
        for state in (*roots, *states):
            path = state.path
            while path and (state.seed, path[:-1]) not in ids:  # the nearest ancestor in the record
                path = path[:-1]
            rows.append(
                {
                    "id": len(rows),
                    "parent": ids[state.seed, path[:-1]] if path else None,
                    "action": state.path[-1] if path else None,
                    "depth": state.depth,
                    "value": state.value if state.valid else None,
                    "objective": state.objective if state.valid else None,
                    "visits": int(state.valid),
                    "nfe": max(0, len(rows) + 1 - len(roots)) * settings["nfe_per_scene"],
                    "mask": tuple(torch.nonzero(state.mask).flatten().tolist()),
                }
            )
            ids[state.seed, state.path] = rows[-1]["id"]
        for row in reversed(rows):
            if row["parent"] is not None:
                rows[row["parent"]]["visits"] += row["visits"]
        searches = [
            {"seed": seed, "root": ids[seed, ()], "best": ids.get((seed, path), ids[seed, ()])}
            for seed, path in best.items()
        ]
        return cls(dict(settings), searches, [TreeNode(**row) for row in rows])

    def path(self, node: int) -> list[int]:
        """Ids from the root to ``node``."""
        ids = [node]
        while (parent := self.nodes[ids[-1]].parent) is not None:
            ids.append(parent)
        return ids[::-1]

    def tree_of(self, search: int) -> list[TreeNode]:
        """Nodes of one search, by its place in ``searches``; the root first."""
        inside = {self.searches[search]["root"]}
        for node in self.nodes:
            if node.parent in inside:
                inside.add(node.id)
        return [self.nodes[node] for node in sorted(inside)]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the record atomically, as JSON with a digest of its content."""
        content = {"format": _FORMAT, **vars(self), "nodes": [asdict(node) for node in self.nodes]}
        write_json(path, with_digest(content), indent=None)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SearchRecord:
        """The record that :meth:`save` wrote.

        Raises:
            FileNotFoundError: the file does not exist.
            CorruptFileError: the file is damaged, or is no search tree.
        """
        text = Path(path).read_bytes()
        try:
            content = json.loads(text)
            kind = content["format"]
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
            raise CorruptFileError(
                f"{str(path)!r} is truncated or no search tree; run the search again with the same output to write it"
            ) from error
        if kind != _FORMAT:
            raise CorruptFileError(f"{str(path)!r} is {kind!r}, and {_FORMAT!r} is needed")
        content = without_digest(content, path)
        nodes = [TreeNode(**{**node, "mask": tuple(node["mask"])}) for node in content["nodes"]]
        return cls(content["settings"], content["searches"], nodes)


def loss_of(plan: PlanResult) -> float:
    """Minus the best value of a plan; infinity if no scene could be scored."""
    return -plan.best_value if math.isfinite(plan.best_value) else math.inf


def figures_of(state: SearchState) -> dict[str, float | None]:
    """Φ and the raw objective of a state; None if it could not be scored."""
    return {"value": state.value, "objective": state.objective} if state.valid else {"value": None, "objective": None}


def plan_figures(plan: PlanResult) -> dict[str, Any]:
    """The figures of a plan for ``metrics.json``."""
    return {
        **figures_of(plan.best_state),
        "path": list(plan.best_path),
        "expansions": len(plan.values),
        "invalid": sum(map(math.isnan, plan.values)),
        "curve": finite(plan.curve),
    }


def draw_curve(
    curves: Mapping[str, Sequence[float]], path: Path, *, num_steps: int, first: int, scale: float, label: str
) -> None:
    """Draw the best Φ after each generated scene (finite ``curves``) against denoiser evaluations, ``num_steps`` per
    scene, one line per planner. A line marks the end of the ``first`` scenes, the fresh samples. ``scale`` is the
    objective called ``label`` at Φ = 1.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots()
    for (name, curve), color in zip(curves.items(), ("#1f6f8b", "#9aa0a6", "#c8553d", "#5a8f29"), strict=False):
        points = [(n * num_steps, scale * v) for n, v in enumerate(curve, start=1) if math.isfinite(v)]
        if points:
            axes.step(*zip(*points, strict=True), where="post", label=name, color=color, linewidth=2)
    if first:
        axes.axvline(first * num_steps, color="#9aa0a6", linewidth=1, linestyle=":", label="first samples")
    axes.set_xlabel("denoiser evaluations (NFE)")
    axes.set_ylabel(f"best {label}")
    axes.set_xlim(left=0)
    if all(math.isclose(scale * v, round(scale * v)) for v in itertools.chain(*curves.values()) if math.isfinite(v)):
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, loc="lower right")
    figure.savefig(path)


def draw_scene(scene: SceneBatch, state: Any, path: Path) -> None:
    """Draw the scene of a search state, a batch of one; the objects that it would regenerate next are red."""
    from scene_envs.render import gallery, render

    marked = state.mask.unsqueeze(0) & scene.is_free
    image = render(scene, width=640, height=480, highlight=marked)[0]
    objects = int(scene.is_free.sum())
    objective = f"objective {state.objective:.4g}" if state.valid else "not scored"
    caption = f"{objective} | {objects} free objects | {int(marked.sum())} to redo (red)"
    gallery([image], columns=1, captions=[caption]).save(path)


@dataclass(frozen=True)
class Card:
    """A scene in the drawing of the best scenes and their ancestors."""

    node: TreeNode
    column: int  # depth, 0 for first samples or the start scene
    row: int  # a first child is in the row of its parent
    parent: int | None  # index of cards
    number: int  # of the scene in the search, from 1
    frame: int | None  # index in the 3-D view
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
) -> None:
    """Write the page of the first search of ``record``, which works offline and without other files. ``scenes`` has a
    batch of one for each id of :func:`shown_nodes`; ``returned`` is the scene that the search returned, if it is not a
    node because the planner changed it at the end.
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
    on_path, baseline = set(way), metrics.get("best_of", {}).get("curve", [])
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
        "baseline": [None if value is None else metrics["objective_scale"] * value for value in baseline],
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


def _cards(record: SearchRecord, shown: Sequence[int], way: Sequence[int]) -> list[Card]:
    """The cards of the shown scenes and of all their ancestors except an empty root, parents first. The best path is in
    the first row; a chain of first children takes the highest row that is free in all its columns.
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


def _words(name: object) -> str:
    return str(name).replace("_", " ")
