"""Sources of scenes: a file, the folder of a run, a dataset. The module does not import torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from scene_envs.scene import SceneBatch

SCENE_FILES = ("ready.safetensors", "scenes.safetensors", "best.safetensors")
"""Files of a run's folder that hold scenes; the first that exists is taken."""
_PRIORS = ("prior/config.json", "config.json")
"""Places of a prior's configuration in a folder."""


def find_scenes(path: Path) -> Path:
    """The file or folder of scenes that ``scenes=`` names; for a run's folder, the scene file in it.

    Raises:
        InvalidInputError: ``path`` does not exist, or the folder holds a prior and no scenes.
    """
    from scene_envs.files import exists

    if not exists(path):
        raise InvalidInputError(
            f"scenes={str(path)[:200]!r}: no scene file, run or dataset is there; sample and generate make them"
        )
    if not path.is_dir():
        return path
    found = next((path / name for name in SCENE_FILES if (path / name).is_file()), path)
    if found == path and any((path / place).is_file() for place in _PRIORS):
        raise InvalidInputError(
            f"scenes={str(path)!r} holds a prior and no scenes; draw some, as with scene-envs sample prior={path}"
        )
    return found


def is_dataset(path: Path) -> bool:
    """Whether a path from :func:`find_scenes` is a dataset or one of its files.

    It is False for a scene file and for a folder of scene files.
    """
    return not _scene_files(path) if path.is_dir() else path.suffix in (".parquet", ".arrow")


def load_scenes(path: Path, count: int | None = None) -> SceneBatch:
    """Scenes from a scene file, a folder of them, a run's folder with a scene file, a dataset or a file of a dataset.

    Args:
        path: File or folder.
        count: Largest number of scenes, the first ones; None for all. Files are read in order of name.

    Raises:
        InvalidInputError: ``count`` is below 1, ``path`` does not exist, or its files are of several scene types.
    """
    from scene_envs.datasets import SceneDataset
    from scene_envs.scene import SceneBatch

    if count is not None and count < 1:
        raise InvalidInputError(f"count must be at least 1, or null for all, got {count}")
    path = find_scenes(path)
    if is_dataset(path):
        return SceneDataset.load(path, limit=count).batch()
    files = _scene_files(path) if path.is_dir() else [path]
    batches = [SceneBatch.load(file) for file in files]
    names = sorted({batch.scene_type.name for batch in batches})
    if len(names) > 1:
        raise InvalidInputError(
            f"the scene files of {str(path)!r} are of several scene types, {', '.join(names)}; name one of the files"
        )
    slots = max(batch.tensor.shape[1] for batch in batches)
    return SceneBatch.concatenate([batch.with_slots(slots) for batch in batches])[:count]


def _scene_files(folder: Path) -> list[Path]:
    """Scene files of a folder that holds no dataset, by name."""
    if any(folder.glob("*.parquet")) or any(folder.glob("*.arrow")):
        return []
    return sorted(path for path in folder.glob("[!.]*.safetensors") if path.is_file())
