"""Scenes from whatever holds them: a file, a run's folder, a dataset. Imports no torch before it reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from scene_envs.scene import SceneBatch

SCENE_FILES = ("ready.safetensors", "scenes.safetensors", "best.safetensors")
"""What is taken from the folder of a run, the first that is there."""


def find_scenes(path: Path, key: str = "scenes") -> Path:
    """The file or dataset folder that a key such as ``scenes=`` names: a run's folder stands for the scenes it holds.

    Raises:
        InvalidInputError: there is nothing.
    """
    from scene_envs.errors import InvalidInputError
    from scene_envs.files import exists

    if not exists(path):
        raise InvalidInputError(
            f"{key}={str(path)[:200]!r}: no scene file, run or dataset is there; sample and generate make them"
        )
    if not path.is_dir():
        return path
    return next((path / name for name in SCENE_FILES if (path / name).is_file()), path)


def load_scenes(path: Path, count: int | None = None) -> SceneBatch:
    """Scenes from a scene file, the folder of a run that has one, a dataset folder or a parquet file.

    Args:
        path: file or folder.
        count: at most so many, the first ones; None for all.

    Raises:
        InvalidInputError: ``count`` below 1, or nothing there.
    """
    from scene_envs.datasets import SceneDataset
    from scene_envs.errors import InvalidInputError
    from scene_envs.scene import SceneBatch

    if count is not None and count < 1:
        raise InvalidInputError(f"count must be at least 1, or null for all, got {count}")
    path = find_scenes(path)
    if path.is_dir() or path.suffix in (".parquet", ".arrow"):
        return SceneDataset.load(path, limit=count).batch()
    batch = SceneBatch.load(path)
    return batch if count is None else batch[:count]
