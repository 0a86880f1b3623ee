"""Several datasets as one endless stream with given probabilities, for cotraining."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from scene_envs.datasets.dataset import SceneDataset
from scene_envs.datasets.splits import Part
from scene_envs.datasets.stream import SceneStream
from scene_envs.datasets.union import to_union, union_normalizer
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType

Source = str | os.PathLike[str] | SceneDataset | SceneStream


class MixedDataset:
    """Batches from several datasets, each chosen with its probability; endless, seeded and resumable.

    Without ``union`` a batch comes whole from one dataset, so its scenes are of one type. With ``union`` every
    *scene* is drawn on its own, and batches hold scenes of all types in the union's categories.

    Args:
        streams: one per dataset.
        probabilities: positive, one per dataset; they are divided by their sum.
        batch_size: scenes per batch.
        seed: of the choices; the order within a dataset is the stream's.
        union: of :func:`~scene_envs.scene_types.union_scene_type`, or None.

    Raises:
        InvalidInputError: no streams, probabilities that do not fit them, or a bad batch size.

    >>> from scene_envs.scene import SceneBatch
    >>> scenes = SceneBatch.empty("dimsum_table", 3)
    >>> dataset = SceneDataset(scenes.tensor, ["a", "b", "c"], Normalizer.fit(scenes.tensor), scenes.scene_type)
    >>> mixed = mix([dataset, dataset], [0.8, 0.2], batch_size=2)
    >>> batch = next(iter(mixed))
    >>> batch.scene_type.name, len(batch)
    ('dimsum_table', 2)
    """

    def __init__(
        self,
        streams: Sequence[SceneStream],
        probabilities: Sequence[float],
        *,
        batch_size: int = 64,
        seed: int = 0,
        union: SceneType | None = None,
    ) -> None:
        weights = np.asarray(probabilities, dtype=np.float64)
        if len(streams) == 0 or weights.shape != (len(streams),) or not (np.isfinite(weights) & (weights > 0)).all():
            raise InvalidInputError(
                f"{len(streams)} datasets need as many positive probabilities, got {list(probabilities)}"
            )
        if batch_size < 1 or seed < 0:
            raise InvalidInputError(f"mixing needs batch_size >= 1 and seed >= 0, got {batch_size} and {seed}")
        self._streams, self._batch_size, self._seed, self._union = list(streams), batch_size, seed, union
        self._probabilities = weights / weights.sum()
        self._step = 0

    @property
    def scene_types(self) -> tuple[SceneType, ...]:
        """Of the datasets, in order."""
        return tuple(stream.scene_type for stream in self._streams)

    @property
    def normalizer(self) -> Normalizer:
        """Covers all datasets; needs ``union``, or datasets of one scene type."""
        union = self._union or self._streams[0].scene_type
        if any(kind.name != union.name for kind in self.scene_types) and self._union is None:
            raise InvalidInputError("datasets of several scene types share a normalizer only in a union; pass union=")
        return union_normalizer([stream.normalizer for stream in self._streams], union)

    def __iter__(self) -> Iterator[SceneDataset]:
        return self

    def __next__(self) -> SceneDataset:
        """The next batch: scenes, prompts, scene type and normalizer."""
        rng = np.random.default_rng([self._seed, self._step])
        if self._union is None:
            chosen = int(rng.choice(len(self._streams), p=self._probabilities))
            batch = self._streams[chosen].take(self._batch_size)
        else:
            batch = self._drawn_together(rng, self._union)
        self._step += 1
        return batch

    def _drawn_together(self, rng: np.random.Generator, union: SceneType) -> SceneDataset:
        source = rng.choice(len(self._streams), size=self._batch_size, p=self._probabilities)  # (B,)
        drawn = [
            (stream.take(int(count)), np.flatnonzero(source == index))
            for index, stream in enumerate(self._streams)
            if (count := (source == index).sum())
        ]
        batches = [to_union(scenes.batch(), union) for scenes, _ in drawn]
        slots = max(batch.tensor.shape[1] for batch in batches)
        place = np.argsort(np.concatenate([rows for _, rows in drawn]))
        tensor = torch.cat([batch.with_slots(slots).tensor for batch in batches])[torch.from_numpy(place)]
        sets = [prompts for scenes, _ in drawn for prompts in scenes.prompt_sets]
        return SceneDataset.from_sets(tensor, [sets[i] for i in place], self.normalizer, union)

    def state_dict(self) -> dict[str, Any]:
        """Position of the mixture; JSON-able."""
        return {"step": self._step, "streams": [stream.state_dict() for stream in self._streams]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to where another mixture of the same datasets and settings was; the next batches are the same."""
        if len(state["streams"]) != len(self._streams):
            raise InvalidInputError(
                f"the state is of a mixture of {len(state['streams'])} datasets, this one has {len(self._streams)}"
            )
        self._step = int(state["step"])
        for stream, saved in zip(self._streams, state["streams"], strict=True):
            stream.load_state_dict(saved)


def mix(
    sources: Sequence[Source],
    probabilities: Sequence[float] | None = None,
    *,
    batch_size: int = 64,
    seed: int = 0,
    part: Part | None = None,
    window: int = 8192,
    union: SceneType | None = None,
) -> MixedDataset:
    """A :class:`MixedDataset` of dataset folders, datasets in memory, or streams.

    Args:
        sources: what to mix. A :class:`SceneStream` keeps its own part, seed and window.
        probabilities: one per source; equal when None.
        batch_size: scenes per batch.
        seed: of the choices, and of the order of each source.
        part: read only this part of every source.
        window: scenes in memory per source, about.
        union: None for batches of one scene type, a union for batches of all.

    Raises:
        InvalidInputError: as :class:`MixedDataset`, or a source cannot be read.
    """
    streams = [
        source
        if isinstance(source, SceneStream)
        else SceneStream(source, part=part, seed=seed + 1000 * index, window=window)
        for index, source in enumerate(sources)
    ]
    weights = [1.0] * len(streams) if probabilities is None else probabilities
    return MixedDataset(streams, weights, batch_size=batch_size, seed=seed, union=union)
