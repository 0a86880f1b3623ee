"""Search tree in ``tree.json``: every scene of a search with its parent, value and cost."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from scene_envs.envs import SearchState
from scene_envs.errors import CorruptFileError
from scene_envs.files import finite, write_json

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
        """The record of searches that started from ``roots``.

        Args:
            roots: a state per search, each with a seed of its own.
            states: all expanded states, in order.
            best: path of the best state, by seed; the best search first.
            settings: settings of the search; must contain ``nfe_per_scene``.
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
        content = finite({**vars(self), "nodes": [asdict(node) for node in self.nodes]})
        write_json(path, {"format": _FORMAT, "sha256": _digest(content), **content}, indent=None)

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
            kind, digest = content.pop("format"), content.pop("sha256")
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError) as error:
            raise CorruptFileError(
                f"{str(path)!r} is truncated or no search tree; run the search again with the same output to write it"
            ) from error
        if kind != _FORMAT:
            raise CorruptFileError(f"{str(path)!r} is {kind!r}, and {_FORMAT!r} is needed")
        if digest != _digest(content):
            raise CorruptFileError(
                f"{str(path)!r} was changed after it was written; run the search again with the same output to write it"
            )
        nodes = [TreeNode(**{**node, "mask": tuple(node["mask"])}) for node in content["nodes"]]
        return cls(content["settings"], content["searches"], nodes)


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=True).encode()).hexdigest()
