"""Refusal of runs that cannot learn, before any scene is sampled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents.configuration.composition import changed
from agents.post_training import learner as learner_module
from agents.post_training import post_train
from agents.post_training.run_files import SCENES_NAME
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.datasets import parse_prompt, scene_facts
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import small_config


def test_prompt_match_without_a_prompt_ends_before_anything_is_sampled(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="'prompt_match' scored none of 2 real scenes"):
        post_train(small_config(tmp_path, reward="prompt_match"), prior=tiny_prior())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": "diversity", "algorithm.credit": "object"}, r"take algorithm\.credit=scene, or auto"),
        (
            {"reward": "diversity", "algorithm.credit": "object", "prompt": "A scene with two cups."},
            r"take algorithm\.credit=scene, or auto",
        ),
    ],
)
def test_what_a_run_lacks_is_told_before_anything_is_sampled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    prior = tiny_prior(process="mixed", text=True)
    monkeypatch.setattr(type(prior), "sample", None)
    monkeypatch.setattr(learner_module, "collect", None)
    config = changed(small_config(tmp_path), changes)
    with pytest.raises(InvalidInputError, match=message):
        post_train(config, prior=prior)
    assert not (tmp_path / "prior").exists()


def test_real_scenes_are_scored_with_their_own_prompts_before_anything_is_sampled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def no_scene(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        asked.append(context.prompts)
        return RewardOutput(batch.counts.float(), valid=torch.zeros(len(batch), dtype=torch.bool))

    monkeypatch.setattr(learner_module.Learner, "rollout", None)  # nothing is sampled
    config = changed(small_config(tmp_path, reward=no_scene), {"prompt": "data", "guard.samples": 0})
    with pytest.raises(TrainingError, match=r"scored none of \d+ real scenes with a prompt, so that nothing"):
        post_train(config, prior=tiny_prior(process="mixed", text=True))
    texts = asked[-1]
    batch = SceneBatch.load(tmp_path / SCENES_NAME)[:8]
    own = np.repeat(np.arange(8), len(texts) // 8)
    for text, facts in zip(texts, scene_facts(batch[torch.from_numpy(own)]), strict=True):
        assert all(check.holds for check in parse_prompt(text, batch.scene_type).check(facts))


def test_a_reward_that_reads_one_kind_of_prompts_alone_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def relations_alone(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        valid = [text.startswith("A scene where") for text in context.prompts or [""] * len(batch)]
        return RewardOutput(batch.counts.float(), valid=torch.tensor(valid))

    monkeypatch.setattr(learner_module.Learner, "rollout", None)
    config = changed(small_config(tmp_path, reward=relations_alone), {"prompt": "data", "guard.samples": 0})
    with pytest.raises(TypeError, match="'NoneType' object is not callable"):  # sampling would begin
        post_train(config, prior=tiny_prior(process="mixed", text=True))
