"""Functions on scenes that several commands share: scoring, making ready, drawing."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from agents.cli.run_folder import Run
    from scene_envs.physics import PhysicsPool
    from scene_envs.scene import SceneBatch

SCENE_FILES = ("ready.safetensors", "scenes.safetensors", "best.safetensors")
"""What is taken from the folder of a run, the first that is there."""
_PRIORS = ("prior/config.json", "config.json")
"""Where a folder has the configuration of a prior."""
_TILE = (400, 300)


def find_scenes(path: Path) -> Path:
    """The file or folder that ``scenes=`` names: a run's folder stands for the scenes it holds.

    Raises:
        InvalidInputError: there is nothing, or a prior and no scenes.
    """
    from scene_envs.errors import InvalidInputError
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
    """Whether what :func:`find_scenes` gave is a dataset or one of its files, and neither scene file nor a folder of
    scene files."""
    return not _scene_files(path) if path.is_dir() else path.suffix in (".parquet", ".arrow")


def load_scenes(path: Path, count: int | None = None) -> SceneBatch:
    """Scenes from a scene file, a folder of such files, the folder of a run that has one, a dataset or a file of one.

    Args:
        path: file or folder.
        count: at most so many, the first ones; None for all. The files of a folder follow each other by name.

    Raises:
        InvalidInputError: ``count`` below 1, nothing there, or files of several scene types.
    """
    from scene_envs.datasets import SceneDataset
    from scene_envs.errors import InvalidInputError
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


def reward_figures(reward: Any, batch: SceneBatch, pool: PhysicsPool | None, run: Run) -> dict[str, Any]:
    """Mean, spread and validity of a reward over the scenes, and the means of its terms."""
    from rewards import RewardContext, evaluate_reward, reward_name

    output = evaluate_reward(reward, batch, RewardContext(pool=pool), strict=True)
    valid = output.is_valid
    value = output.value[valid].double()
    figures: dict[str, Any] = {"name": reward_name(reward), "valid": int(valid.sum())}
    if len(value):
        figures |= {"mean": float(value.mean()), "std": float(value.std(unbiased=False)), "max": float(value.max())}
        figures["terms"] = {name: float(term[valid].double().mean()) for name, term in output.terms.items()}
        run.say(f"{figures['name']}: {figures['mean']:.4g} on average, {figures['max']:.4g} at best")
    return figures


def make_ready(batch: SceneBatch, pictures: int, pool: PhysicsPool | None, run: Run) -> dict[str, Any]:
    """Project and settle the scenes into ``ready.safetensors`` and ``ready.png``; returns the figures."""
    from scene_envs import physics

    result = physics.make_ready(batch, pool=pool)
    result.batch.save(run.directory / "ready.safetensors")
    valid = result.valid
    free = int(batch.is_free[valid].sum())
    figures: dict[str, Any] = {"valid": int(valid.sum())}
    if bool(valid.any()):
        counts = result.counts[valid]
        figures |= {"mean": float(counts.double().mean()), "fraction": float(counts.sum()) / max(free, 1)}
        run.say(
            f"simulation-ready: {figures['mean']:.1f} objects per scene, {figures['fraction']:.0%} of the free ones"
        )
    captions = [
        f"{int(ready)} of {int(total)} ready"
        for ready, total in zip(result.counts, batch.is_free.sum(dim=-1), strict=True)
    ]
    draw_scenes(result.batch, pictures, run, "ready.png", captions)
    return figures


def draw_scenes(batch: SceneBatch, count: int, run: Run, name: str, captions: list[str] | None = None) -> None:
    """A gallery of the first ``count`` scenes."""
    from scene_envs.render import gallery, render

    if count < 1:
        return
    shown = batch[: min(count, len(batch))]
    if captions is None:
        captions = [f"{int(objects)} objects" for objects in shown.counts]
    images = render(shown, width=_TILE[0], height=_TILE[1])
    gallery(list(images), columns=4, captions=captions[: len(shown)]).save(run.directory / name)
