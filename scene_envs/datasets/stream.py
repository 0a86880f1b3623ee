"""Stream of a dataset larger than memory: endless shuffled scenes, read window by window, resumable."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from scene_envs.datasets.dataset import SceneDataset, make_layout
from scene_envs.datasets.files import Block, find_files, find_metadata, list_blocks, read_block
from scene_envs.datasets.layout import FIXED_TOLERANCE, scene_keys
from scene_envs.datasets.splits import Part
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType


class SceneStream:
    """Scenes of one dataset without end, in a random order, a window of them in memory.

    Each epoch visits every scene (of the part) once. It shuffles the blocks of all files (2,000 rows at most),
    gathers them into windows, and shuffles the scenes of a window. The order depends on the seed and the files
    alone, and the state is three integers: resuming reads one window again and goes on exactly.

    Args:
        source: a dataset folder or file, as for :meth:`SceneDataset.load`, or a dataset in memory.
        part: read only this part (scenes are decided by key, so train and test streams never meet).
        seed: of the order.
        window: scenes in memory, about.
        scene_type: as for :meth:`SceneDataset.load`.
        aliases: as for :meth:`SceneDataset.load`.
        metadata: as for :meth:`SceneDataset.load`.
        fixed_tolerance: as for :meth:`SceneDataset.load`.
        slots: as for :meth:`SceneDataset.load`.

    Attributes:
        scene_type: of the scenes.
        normalizer: of the dataset.

    >>> from scene_envs.scene import SceneBatch
    >>> scenes = SceneBatch.empty("dimsum_table", 3)
    >>> dataset = SceneDataset(scenes.tensor, ["a", "b", "c"], Normalizer.fit(scenes.tensor), scenes.scene_type)
    >>> stream = SceneStream(dataset)
    >>> sorted(stream.take(3).prompts), len(stream.take(5))
    (['a', 'b', 'c'], 5)
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | SceneDataset,
        *,
        part: Part | None = None,
        seed: int = 0,
        window: int = 8192,
        scene_type: str | SceneType | None = None,
        aliases: Mapping[str, str] | None = None,
        metadata: str | os.PathLike[str] | None = None,
        fixed_tolerance: float = FIXED_TOLERANCE,
        slots: int | None = None,
    ) -> None:
        if window < 1 or seed < 0:
            raise InvalidInputError(f"a stream needs window >= 1 and seed >= 0, got window={window}, seed={seed}")
        self._part, self._seed, self._window_size = part, seed, window
        self._memory = source if isinstance(source, SceneDataset) else None
        self._blocks: list[Block] = []
        self.scene_type: SceneType
        self.normalizer: Normalizer
        if isinstance(source, SceneDataset):
            self.scene_type, self.normalizer = source.scene_type, source.normalizer
        else:
            self._layout = make_layout(metadata or find_metadata(source), scene_type, aliases, fixed_tolerance, slots)
            self.scene_type, self.normalizer = self._layout.scene_type, self._layout.normalizer
            self._blocks = [block for file in find_files(source) for block in list_blocks(file)]
        self._epoch = self._window = self._offset = 0
        self._plan: list[list[Block]] | None = None  # windows of this epoch
        self._scenes: SceneDataset | None = None  # those of this window, shuffled

    def take(self, count: int) -> SceneDataset:
        """The next ``count`` scenes.

        Raises:
            InvalidInputError: the dataset, or its part, holds no scene.
            CorruptFileError: a file cannot be read.
        """
        pieces: list[SceneDataset] = []
        missing, barren = count, 0
        while missing > 0:
            scenes = self._current()
            piece = scenes[self._offset : self._offset + missing]
            if len(piece):
                pieces.append(piece)
                self._offset += len(piece)
                missing -= len(piece)
                barren = 0
            if missing > 0:
                barren = self._advance(barren)
        if not pieces:
            return self._current()[:0]
        return _joined(pieces)

    def state_dict(self) -> dict[str, int]:
        """Position of the stream; JSON-able."""
        return {"epoch": self._epoch, "window": self._window, "offset": self._offset}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to where another stream of the same dataset, part, seed and window was."""
        self._epoch, self._window, self._offset = (int(state[key]) for key in ("epoch", "window", "offset"))
        self._plan = self._scenes = None

    def _advance(self, barren: int) -> int:
        """Go to the next window; ``barren`` counts epoch ends since the last scene."""
        self._scenes = None
        self._window, self._offset = self._window + 1, 0
        if self._window < len(self._windows()):
            return barren
        if barren:
            raise InvalidInputError(f"no scene to stream in {self._part or 'the dataset'}")
        self._epoch, self._window, self._plan = self._epoch + 1, 0, None
        return barren + 1

    def _windows(self) -> list[list[Block]]:
        if self._plan is None:
            order = np.random.default_rng([self._seed, self._epoch]).permutation(len(self._blocks))
            self._plan, rows = [[]], 0
            for block in (self._blocks[i] for i in order):
                if rows >= self._window_size:
                    self._plan.append([])
                    rows = 0
                self._plan[-1].append(block)
                rows += block.rows
        return self._plan

    def _current(self) -> SceneDataset:
        if self._scenes is None:
            scenes = self._read(self._windows()[self._window])
            if self._part is not None:
                scenes = scenes[torch.from_numpy(np.flatnonzero(self._part.contains(scene_keys(scenes.tensor))))]
            order = np.random.default_rng([self._seed, self._epoch, self._window]).permutation(len(scenes))
            self._scenes = scenes[torch.from_numpy(order)]
        return self._scenes

    def _read(self, blocks: list[Block]) -> SceneDataset:
        if self._memory is not None:
            return self._memory
        rows = (read_block(block, self._layout.info.features) for block in blocks)
        return SceneDataset._collect(rows, self._layout, None)


def _joined(pieces: list[SceneDataset]) -> SceneDataset:
    first = pieces[0]
    if len(pieces) == 1:
        return first
    width = max(piece.tensor.shape[1] for piece in pieces)
    tensor = torch.cat([piece.batch().with_slots(width).tensor for piece in pieces])
    sets = [prompts for piece in pieces for prompts in piece.prompt_sets]
    return SceneDataset.from_sets(tensor, sets, first.normalizer, first.scene_type, first.metadata)
