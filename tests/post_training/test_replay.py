"""Replayed scenes: a share of the batches of the pretraining loss, kept in the run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Generator

from agents.post_training import PostTrainConfig, post_train
from agents.post_training.scene_bank import SceneBank
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import count_objects


def replay_config(output: Path, replay: Path | None, **changes: Any) -> PostTrainConfig:
    """Four short iterations with ``replay`` in the regularisation."""
    keys: dict[str, Any] = {
        "reward": count_objects,
        "iterations": 4,
        "batch_size": 6,
        "num_steps": 4,
        "algorithm": {"name": "nft"},
        "regularisation": {"weight": 1.0, "batch_size": 4, "bank_size": 24, "replay": replay and str(replay)},
        "guard": {"scenes": 8, "every": 2},
        "logger": {"checkpoint_every": 2, "progress": "none"},
    }
    return PostTrainConfig(output=str(output), **(keys | changes))


def test_a_share_of_each_batch_is_replayed() -> None:
    real, replay = torch.zeros(20, 3, 2), torch.arange(5.0).add(1).reshape(5, 1, 1).expand(5, 3, 2)
    bank = SceneBank.split(real, 4, lambda i: (f"scene {i}",)).with_replay(replay, 0.3)
    batch = bank.batch(10, Generator().manual_seed(0))
    x0, texts = batch.scenes, batch.prompts
    assert not x0[:7].any()
    assert set(x0[7:].flatten().tolist()) <= set(replay.flatten().tolist())
    assert texts is not None
    assert texts[7:] == [""] * 3
    assert any(texts[:7])


def test_the_guard_holds_out_real_scenes_alone() -> None:
    bank = SceneBank.split(torch.zeros(20, 3, 2), 4).with_replay(torch.ones(5, 3, 2), 1.0)
    assert not bank.heldout.any()
    assert bank.batch(6, Generator().manual_seed(0)).scenes.all()


@pytest.mark.slow
def test_a_run_with_replay_goes_on_without_its_source(tmp_path: Path) -> None:
    prior = tiny_prior()
    source = tmp_path / "winners" / "best.safetensors"
    source.parent.mkdir()
    prior.sample(3, num_steps=4, seed=1).save(source)
    whole = post_train(replay_config(tmp_path / "whole", source.parent, iterations=3), prior=tiny_prior())
    post_train(replay_config(tmp_path / "parts", source.parent, iterations=2), prior=tiny_prior())
    source.unlink()
    parts = post_train(replay_config(tmp_path / "parts", source.parent, iterations=3), prior=tiny_prior())
    plain = post_train(replay_config(tmp_path / "plain", None, iterations=1), prior=tiny_prior())
    losses = [[row["pretraining_loss"] for row in run.history] for run in (whole, parts, plain)]
    assert losses[0] == losses[1]
    assert losses[0][0] != losses[2][0]


@pytest.mark.parametrize("fault", ["nothing there", "another scene type", "no scene", "too many slots"])
def test_replay_that_cannot_serve_is_refused_before_sampling(tmp_path: Path, fault: str) -> None:
    prior, path = tiny_prior(), tmp_path / "scenes.safetensors"
    words = {
        "nothing there": "no scene file, run or dataset is there",
        "another scene type": "pantry_shelf",
        "no scene": "holds no scene",
        "too many slots": "slots=",
    }
    slots = max(prior.scene_type.slots, prior.config.slots)
    if fault == "another scene type":
        SceneBatch.empty(get_grammar("pantry_shelf").scene_type, 2, 61).save(path)
    elif fault != "nothing there":
        count, width = (0, slots) if fault == "no scene" else (2, slots + 1)
        SceneBatch.empty(prior.scene_type, count, width).save(path)
    with pytest.raises(InvalidInputError, match=r"regularisation\.replay=") as raised:
        post_train(replay_config(tmp_path / "run", path), prior=prior)
    assert words[fault] in str(raised.value)
