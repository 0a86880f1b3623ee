"""Samples of the base prior, with which the discriminative regularisation compares real scenes."""

from __future__ import annotations

from pathlib import Path

from torch import Generator

from agents.post_training.config import PostTrainConfig
from agents.post_training.rollouts import stream_seed
from agents.post_training.run_files import BASE_SAMPLES_NAME, writing
from agents.post_training.scene_bank import PromptedScenes, SceneBank
from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup
from scene_envs.progress import Progress
from scene_envs.scene import SceneBatch


def kept_base_samples(
    directory: Path,
    base: ScenePrior,
    bank: SceneBank,
    config: PostTrainConfig,
    *,
    reuse: bool,
    progress: str = "none",
) -> PromptedScenes:
    """The base prior's samples of a run, kept in its folder; the first process draws them.

    The samples have the prompts of real scenes, so that prompts do not distinguish samples from real scenes.

    Args:
        directory: folder of the run.
        base: the base prior.
        bank: real scenes, which give the prompts and the number of slots.
        config: configuration of the run.
        reuse: load the samples that are already in the folder, as a resumed run does.
        progress: a style of :class:`~scene_envs.progress.Progress`.
    """
    path, processes, count = directory / BASE_SAMPLES_NAME, ProcessGroup.current(), config.regularisation.base_samples
    prompts = bank.batch(count, Generator().manual_seed(stream_seed(config.seed, "base_prompts"))).prompts
    if processes.is_first and not (reuse and path.exists()):
        with Progress("base samples", count, style=progress, always=(0,)) as shown:
            shown.update(0, "", f"drawing {count} samples of the base prior")
            batch = base.sample(
                count,
                prompt=prompts,
                physics_guidance=0.0,
                num_steps=config.num_steps,
                slots=bank.train.shape[1],
                seed=stream_seed(config.seed, "base_samples"),
                batch_size=config.batch_size,
            )
        writing(f"the base prior's samples {str(path)!r}", lambda: batch.save(path))
    processes.wait()
    return PromptedScenes(base.encode(SceneBatch.load(path).to(base.device)), prompts)
