"""Real scenes for the regularisation and for the guard: from a dataset, or from the grammar."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from agents.post_training.rollouts import PROMPTS_NAME, PromptSets, stream_seed
from agents.post_training.run_files import BASE_SAMPLES_NAME, SCENES_NAME
from agents.post_training.settings import RegularisationSettings
from agents.priors.prior import ScenePrior, asked_objects
from agents.utils.process_group import ProcessGroup
from scene_envs import __version__
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.files import cache_folder, trim_folder, write_text
from scene_envs.progress import Progress
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

_LOGGER = logging.getLogger(__name__)
_WITHHELD = 0.1
"""Share of real scenes whose prompt is withheld, as in pretraining."""
_AT_ONCE = 16
"""Number of scenes of the grammar between two updates of the progress; as many are compared with kept scenes."""
_CACHE_SIZE = 512 * 2**20
"""Bytes of the grammar's scenes that are kept for later runs."""


@dataclass(frozen=True)
class PromptedScenes:
    """Normalised scenes and one prompt for each."""

    scenes: Tensor  # (M, N, D)
    prompts: Sequence[str] | None  # ``""`` for a scene without one; None for a prior that reads no prompts

    def batch(self, count: int, generator: Generator) -> PromptedScenes:
        """``count`` scenes and their prompts, drawn with replacement."""
        index = torch.randint(len(self.scenes), (count,), generator=generator)
        prompts = None if self.prompts is None else [self.prompts[i] for i in index.tolist()]
        return PromptedScenes(self.scenes[index], prompts)


@dataclass(frozen=True)
class SceneBank:
    """Normalised real scenes, in a fixed split into training scenes and held-out scenes."""

    train: Tensor  # (M, N, D), for the regularisation
    heldout: Tensor  # (K, N, D), for the guard
    prompts: PromptSets | None = None  # all prompts of a scene by its index, held-out scenes after training scenes
    base: PromptedScenes | None = None  # samples of the base prior

    @classmethod
    def split(cls, x0: Tensor, heldout: int, prompts: PromptSets | None = None) -> SceneBank:
        """A bank of ``x0`` (M, N, D), of which the last ``heldout`` scenes are held out."""
        if not 0 < heldout < len(x0):
            raise InvalidInputError(f"{len(x0)} real scenes cannot spare {heldout} for the guard; give more scenes")
        return cls(x0[:-heldout], x0[-heldout:], prompts)

    def batch(self, count: int, generator: Generator) -> PromptedScenes:
        """``count`` training scenes, drawn with replacement, each with one of its prompts. As in pretraining, the
        prompt is withheld (``""``) from one scene in ten.
        """
        index = torch.randint(len(self.train), (count,), generator=generator)
        texts = None
        if self.prompts is not None:
            choice, withheld = torch.rand(2, count, generator=generator).tolist()
            texts = [
                "" if drop < _WITHHELD else (group := self.prompts(i))[int(pick * len(group))]
                for i, pick, drop in zip(index.tolist(), choice, withheld, strict=True)
            ]
        return PromptedScenes(self.train[index], texts)

    def heldout_prompts(
        self, count: int | None = None, slots: int | None = None, scene_type: SceneType | None = None
    ) -> list[str] | None:
        """One prompt of each held-out scene, or of the first ``count``; kinds of prompts alternate. None without
        prompts. ``""`` replaces a prompt for more than ``slots`` objects of ``scene_type``; ``slots`` None allows any
        number.
        """
        if self.prompts is None:
            return None
        first, count = len(self.train), len(self.heldout) if count is None else count
        texts = [(group := self.prompts(first + i))[i % len(group)] for i in range(count)]
        if slots is None or scene_type is None:
            return texts
        return [text if asked_objects(text, scene_type) <= slots else "" for text in texts]


def kept_scenes(
    directory: Path,
    prior: ScenePrior,
    settings: RegularisationSettings,
    seed: int,
    slots: int,
    *,
    reuse: bool,
    progress: str = "none",
) -> SceneBatch:
    """The real scenes of a run, kept in its folder with the prompts of a dataset; the first process draws them.
    ``reuse`` loads those that are already in the folder, as a resumed run does.
    """

    def draw() -> SceneBatch:
        texts, count = directory / PROMPTS_NAME, settings.bank_size
        batch, found = real_scenes(prior, settings.scenes, count, seed=seed, slots=slots, progress=progress)
        texts.unlink(missing_ok=True)  # prompts of other scenes, left by a run without a checkpoint
        if found is not None and prior.conditional:
            write_text(texts, json.dumps([list(prompts) for prompts in found]) + "\n")
        return batch

    return _kept(directory / SCENES_NAME, reuse, draw)


def _kept(path: Path, reuse: bool, draw: Callable[[], SceneBatch]) -> SceneBatch:
    """The scenes in ``path``, which the first process draws and writes, unless ``reuse`` finds them there."""
    processes = ProcessGroup.current()
    if processes.is_first and not (reuse and path.exists()):
        batch = draw()
        batch.save(path)
    processes.wait()
    return SceneBatch.load(path)


def real_scenes(
    prior: ScenePrior, source: str, count: int, *, seed: int, slots: int | None = None, progress: str = "none"
) -> tuple[SceneBatch, list[tuple[str, ...]] | None]:
    """``count`` scenes of the prior's type from ``"grammar"`` or a dataset folder (all it has, if fewer), and the
    prompts of each if they have any. ``seed`` is that of the grammar, or of the choice of rows. ``slots`` is the
    smallest number per scene (None: as in training); scenes keep all their slots, because a prior reads any number of
    slots.
    """
    slots = max(prior.scene_type.slots, prior.config.slots if slots is None else slots)
    if source == "grammar":
        return _grammar_scenes(prior.scene_type, count, seed, progress).with_slots(slots), None
    from scene_envs.datasets import SceneDataset

    if not Path(source).is_dir():
        raise InvalidInputError(f"real_scenes={source!r} is neither 'grammar' nor the directory of a dataset")
    dataset = SceneDataset.load(source)
    rows = torch.randperm(len(dataset.tensor), generator=Generator().manual_seed(seed))[:count]
    batch = SceneBatch(dataset.tensor[rows], prior.scene_type)
    return batch.with_slots(max(slots, batch.tensor.shape[1])), [dataset.prompt_sets[i] for i in rows.tolist()]


def _grammar_scenes(scene_type: SceneType, count: int, seed: int, progress: str) -> SceneBatch:
    """``count`` scenes of the grammar, from the cache if an earlier run kept them. The first ones are drawn in any
    case, so that kept scenes of another grammar are noticed.
    """
    from scene_envs import grammars

    rng, grammar, title = np.random.default_rng(seed), grammars.get_grammar(scene_type), "real scenes"
    parts = [grammar.sample(rng, min(_AT_ONCE, count))]
    key = hashlib.sha256(f"{__version__} {np.__version__}".encode())
    for file in sorted(Path(grammars.__path__[0]).glob("*.py")):
        key.update(file.read_bytes())
    path = cache_folder() / "real_scenes" / f"{scene_type.name}-{seed}-{count}-{key.hexdigest()[:16]}.safetensors"
    try:
        kept = SceneBatch.load(path).tensor if path.exists() else None
        if kept is not None and len(kept) == count and torch.equal(kept[: len(parts[0])], parts[0].tensor):
            path.touch()  # those used last are kept longest
            return SceneBatch(kept, scene_type)
        reason = "" if kept is None else "the grammar draws others now"
    except (SceneEnvsError, OSError) as error:
        reason = str(error)
    if reason:
        _LOGGER.warning("the real scenes kept in %s are not taken and drawn anew: %s", path, reason)
    with Progress(title, count, style=progress) as shown:
        for first in range(_AT_ONCE, count, _AT_ONCE):
            parts.append(grammar.sample(rng, min(_AT_ONCE, count - first)))
            done = first + len(parts[-1])
            shown.update(done, "", f"{title} {done}/{count}")
    batch = SceneBatch.concatenate(parts)
    if len(parts) > 1:
        try:
            batch.save(path)
            trim_folder(path.parent, _CACHE_SIZE)
        except OSError as error:
            _LOGGER.warning("real scenes could not be kept in %s: %s", path.parent, error)
    return batch


def kept_base_samples(
    directory: Path,
    base: ScenePrior,
    bank: SceneBank,
    count: int,
    seed: int,
    *,
    num_steps: int,
    batch_size: int,
    reuse: bool,
    progress: str = "none",
) -> PromptedScenes:
    """The base prior's samples of a run, kept in its folder; the first process draws them, or ``reuse`` loads them.
    They have the prompts of real scenes, so that prompts do not distinguish samples from real scenes.
    """
    prompts = bank.batch(count, Generator().manual_seed(stream_seed(seed, "base_prompts"))).prompts

    def draw() -> SceneBatch:
        with Progress("base samples", count, style=progress, always=(0,)) as shown:
            shown.update(0, "", f"drawing {count} samples of the base prior")
            return base.sample(
                count, prompt=prompts, physics_guidance=0.0, num_steps=num_steps, slots=bank.train.shape[1],
                seed=stream_seed(seed, "base_samples"), batch_size=batch_size,
            )  # fmt: skip

    samples = _kept(directory / BASE_SAMPLES_NAME, reuse, draw)
    return PromptedScenes(base.encode(samples.to(base.device)), prompts)
