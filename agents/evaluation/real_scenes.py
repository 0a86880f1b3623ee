"""Real scenes with which samples are compared, from a dataset or from the grammar."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from agents.evaluation.measure import grammar_scenes
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

_FLOOR_SEED = 1_000_003
"""Added to the seed of the grammar for the second set of scenes."""


@dataclass(frozen=True)
class RealScenes:
    """Disjoint sets of real scenes.

    Attributes:
        reference: held-out scenes with which samples are compared.
        floor: other held-out scenes, equivalent to samples of a perfect sampler.
        training: scenes on which the prior may have been trained; None if the other scenes are from the grammar.

    >>> from scene_envs.scene_types import get_scene_type
    >>> real = RealScenes.load(get_scene_type("dimsum_table"), 2)
    >>> len(real.reference), len(real.floor), real.training
    (2, 2, None)
    """

    reference: SceneBatch
    floor: SceneBatch
    training: SceneBatch | None = None

    @classmethod
    def load(
        cls, scene_type: SceneType, count: int, *, data: str = "", heldout: str = "", training: int = 20_000,
        seed: int = 0,
    ) -> RealScenes:  # fmt: skip
        """Held-out scenes, at most ``count`` in each of the two sets, and training scenes.

        Args:
            scene_type: scene type of the samples.
            count: largest number of scenes in ``reference`` and in ``floor``.
            data: dataset folder of the training scenes, or several joined by commas for a prior of their union;
                empty takes fresh scenes of the grammar, and no training scenes.
            heldout: dataset folder, or folders, of held-out scenes; empty takes the last scenes of ``data``, at most
                half of it.
            training: number of training scenes, drawn at random.
            seed: seed of the grammar and of the draw.

        Raises:
            InvalidInputError: a folder does not exist, its scenes are of another type, there are fewer than four
                held-out scenes, or a number is below 1.
            CorruptFileError: a file cannot be read, lacks a column, or holds rows that are not scenes.
        """
        if count < 2 or training < 1:
            raise InvalidInputError(
                f"an evaluation needs count >= 2 and training_scenes >= 1, got count={count} and "
                f"training_scenes={training}"
            )
        if not data:
            if heldout:
                raise InvalidInputError(f"heldout={heldout!r} needs data=, the folder of the training scenes")
            return cls(
                grammar_scenes(scene_type, count, seed), grammar_scenes(scene_type, count, seed + _FLOOR_SEED), None
            )
        folders, held_folders = _folders(data), _folders(heldout)
        if heldout and len(held_folders) != len(folders):
            raise InvalidInputError(
                f"data names {len(folders)} folders and heldout {len(held_folders)}; give the same number"
            )
        share = -(-count // len(folders))
        parts = [
            _split(folder, held, scene_type, share, -(-training // len(folders)), seed)
            for folder, held in zip(folders, held_folders or [""] * len(folders), strict=True)
        ]
        slots = max(part.tensor.shape[1] for group in parts for part in group)
        reference, floor, train = (
            _in_turn([part.with_slots(slots) for part in group]) for group in zip(*parts, strict=True)
        )
        return cls(reference, floor, train)


def _split(
    folder: str, heldout: str, scene_type: SceneType, count: int, training: int, seed: int
) -> tuple[SceneBatch, SceneBatch, SceneBatch]:
    """Reference, floor and training scenes of one folder; no scene is in two of them."""
    whole = _read(folder, scene_type)
    if heldout:
        held, train = _distinct(_read(heldout, scene_type)), whole
    else:
        kept = min(2 * count, len(whole) // 2)
        held, train = _distinct(whole[len(whole) - kept :]), whole[: len(whole) - kept]
    half = min(count, len(held) // 2)
    if half < 2:
        raise InvalidInputError(
            f"{heldout or folder!r} has {len(held)} distinct held-out scenes; at least 4 are needed, half of them for "
            "the real-against-real floor: generate more, or name a folder with more as heldout="
        )
    train = train[~np.isin(_keys(train), _keys(held))]
    if not len(train):
        raise InvalidInputError(
            f"all scenes of data={folder!r} are held-out scenes too; novelty has nothing to compare"
        )
    order = torch.randperm(len(train), generator=torch.Generator().manual_seed(seed))[:training]
    batches = (held[:half], held[half : 2 * half], train[order])
    return tuple(SceneBatch(tensor, scene_type) for tensor in batches)  # type: ignore[return-value]


def _in_turn(parts: list[SceneBatch]) -> SceneBatch:
    """The scenes of all parts, in turn, so that any first scenes are from all parts."""
    numbers = torch.cat([torch.arange(len(part)) for part in parts])
    whole = SceneBatch.concatenate(parts)
    return whole[numbers.argsort(stable=True)]


def _read(folder: str, scene_type: SceneType) -> Tensor:
    """(M, N, D) raw scenes of a dataset, in the categories of ``scene_type``."""
    from scene_envs.datasets import SceneDataset, to_union

    if not Path(folder).exists():
        raise InvalidInputError(f"no dataset at {folder!r}; scene-envs generate makes one")
    dataset = SceneDataset.load(folder)
    if dataset.scene_type.assets == scene_type.assets:
        return dataset.tensor
    if dataset.scene_type.name not in scene_type.name.split("+"):
        raise InvalidInputError(
            f"{folder!r} holds scenes of {dataset.scene_type.name!r}, the samples are of {scene_type.name!r}; name a "
            "dataset of that scene type"
        )
    return to_union(dataset.batch(), scene_type).tensor


def _distinct(tensor: Tensor) -> Tensor:
    _, first = np.unique(_keys(tensor), return_index=True)
    return tensor[torch.from_numpy(np.sort(first))]


def _keys(tensor: Tensor) -> np.ndarray[tuple[int], np.dtype[np.uint64]]:
    from scene_envs.datasets.layout import scene_keys

    return scene_keys(tensor)


def _folders(text: str) -> list[str]:
    return [folder.strip() for folder in text.split(",") if folder.strip()]
