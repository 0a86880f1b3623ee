"""Runs that sample under claim guidance: numbers of prompts hold in every batch, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.diffusion.reverse_steps import concatenate_steps
from agents.post_training import PostTrainConfig, PostTrainer
from agents.post_training.rollouts import finished_scenes
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.small_runs import count_objects

TWO = ["A scene with nine objects.", "A scene with 20 objects."]


def reader() -> ScenePrior:
    return tiny_prior(process="mixed", text=True, kernel="squared_absorbing")


def config(output: Path, **changes: Any) -> PostTrainConfig:
    keys: dict[str, Any] = {
        "algorithm": {"name": "nft", "scenes_per_prompt": 4},
        "optimizer": {"lr": 1e-3},
        "guard": {"scenes": 24, "samples": 20, "every": 2, "samples_every": 2},
    }
    regularisation = {"weight": 1.0, "batch_size": 4, "bank_size": 32}
    return PostTrainConfig(
        reward=count_objects, prompt=TWO, claim_guidance=1.0, iterations=2, batch_size=8, num_steps=20,
        regularisation=regularisation, progress="none", output=str(output), **(keys | changes),
    )  # fmt: skip


@pytest.mark.parametrize("chunk", [None, 3])
def test_the_scenes_of_a_batch_hold_the_numbers_of_their_prompts(tmp_path: Path, chunk: int | None) -> None:
    algorithm = {"name": "nft", "scenes_per_prompt": 4}
    trainer = PostTrainer(config(tmp_path, algorithm=algorithm, optimizer={"lr": 1e-3, "chunk": chunk}), prior=reader())
    trainer.prepare()
    scenes, prompts = finished_scenes(trainer.learner.rollout(0)), trainer.learner.env.core.prompts
    trainer.close()
    assert prompts is not None
    assert scenes.counts.tolist() == [{TWO[0]: 9, TWO[1]: 20}[prompt] for prompt in prompts]


def test_the_guard_samples_as_the_run_does(tmp_path: Path) -> None:
    trainer = PostTrainer(config(tmp_path), prior=reader())
    trainer.prepare()
    check = trainer.guard.samples
    trainer.close()
    assert check is not None
    guided = replace(check, prompts=TWO * 10).sample(reader())
    assert guided.counts.tolist() == [9, 20] * 10


def test_steps_of_chunks_keep_the_scenes_that_the_network_expects() -> None:
    prior = reader()
    step = prior.transition(prior.initial(3, 34), 5, prior.step_table(20))
    joined = concatenate_steps([step, step])
    assert joined.denoised is not None
    assert step.denoised is not None
    torch.testing.assert_close(joined.denoised, torch.cat([step.denoised, step.denoised]))
    assert concatenate_steps([step, step.take(torch.arange(3))]).denoised is None


@pytest.mark.parametrize("algorithm", ["ddpo_sf", "ddpo_is"])
def test_algorithms_that_need_log_probabilities_are_refused(tmp_path: Path, algorithm: str) -> None:
    with pytest.raises(InvalidInputError, match=rf"claim_guidance=1 .*algorithm={algorithm} .*algorithm=nft or awm"):
        config(tmp_path, algorithm={"name": algorithm})


@pytest.mark.parametrize("prompt", [None, ""])
def test_guidance_without_prompts_is_refused(prompt: str | None) -> None:
    with pytest.raises(InvalidInputError, match="prompt"):
        PostTrainConfig(prompt=prompt, claim_guidance=1.0, algorithm={"name": "nft"})
