"""Post-training of adapters: what is trained, what is written, and what a resumed run or a rollback finds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.configuration import changed, compose
from agents.post_training import PostTrainConfig, post_train
from agents.post_training.algorithms import algorithm_settings
from agents.post_training.trainer import PostTrainer
from agents.priors import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.small_runs import small_config


def _config(output: Path, base: Path, algorithm: str = "ddpo_sf", **changes: Any) -> PostTrainConfig:
    settings = algorithm_settings(algorithm)(credit="scene")  # type: ignore[call-arg]
    values = {"prior": str(base), "algorithm": settings, "adapter.rank": 2, "optimizer.lr": 1e-2}
    return changed(small_config(output, reward="object_count"), {**values, **changes})


@pytest.fixture(params=[("continuous", "ddpo_sf"), ("mixed", "nft")], ids=["ddpo_sf", "nft"])
def setting(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    process, algorithm = request.param
    return tiny_prior(process=process).save(tmp_path / "base"), algorithm


@pytest.mark.slow
def test_a_run_writes_an_adapter_that_makes_its_prior_of_the_base(setting: tuple[Path, str], tmp_path: Path) -> None:
    base, algorithm = setting
    result = post_train(_config(tmp_path / "run", base, algorithm, iterations=2))
    loaded, before = ScenePrior.load(base, adapter=tmp_path / "run").weights(), ScenePrior.load(base).weights()
    moved = set()
    for name, weight in result.prior.weights().items():
        assert torch.allclose(loaded[name], weight, atol=1e-6)
        moved |= {name} if not torch.equal(before[name], weight) else set()
    assert moved
    assert all("linear" in name or "qkv" in name or "out" in name or "mlp" in name for name in moved)


@pytest.mark.slow
def test_a_killed_run_goes_on_bit_for_bit(setting: tuple[Path, str], tmp_path: Path) -> None:
    base, algorithm = setting
    whole = post_train(_config(tmp_path / "whole", base, algorithm, iterations=3))
    config = _config(tmp_path / "killed", base, algorithm, iterations=3)
    post_train(changed(config, {"iterations": 2}))
    resumed = post_train(config)
    assert [row["gradient_norm"] for row in resumed.history] == [row["gradient_norm"] for row in whole.history]
    for name, tensor in whole.prior.weights().items():
        assert torch.equal(tensor, resumed.prior.weights()[name])


@pytest.mark.slow
def test_a_rollback_takes_the_best_updates_again(setting: tuple[Path, str], tmp_path: Path) -> None:
    base, algorithm = setting
    config = _config(tmp_path / "run", base, algorithm, **{"guard.limit": 1e-6, "guard.action": "rollback"})
    trainer = PostTrainer(config)
    try:
        result = trainer.run()
    finally:
        trainer.close()
    assert result.metrics["guard"]["rollbacks"] == 2
    weights, first = trainer.prior.weights(), ScenePrior.load(base).weights()
    assert all(torch.equal(weights[name], first[name]) for name in first)  # nothing was better than the base


def test_keys_of_the_group_and_of_the_file_do_not_meet() -> None:
    config = compose("post-train", PostTrainConfig, ["adapter.rank=4", "prior=dimsum_table"])
    assert (config.adapter.rank, config.prior) == (4, "dimsum_table")
    assert config.optimizer.lr == pytest.approx(10 * config.algorithm.learning_rate)
    assert compose("post-train", PostTrainConfig, ["adapter={rank: 4}"]).adapter.rank == 4
    config = compose("post-train", PostTrainConfig, ["adapter=runs/a", "prior=dimsum_table"])
    assert (config.adapter.rank, config.prior) == (0, "dimsum_table with runs/a")
    with pytest.raises(InvalidInputError, match="one prior"):
        compose("post-train", PostTrainConfig, ["adapter=runs/a", "adapter.rank=4", "prior=dimsum_table"])
    with pytest.raises(InvalidInputError, match="rank=-1"):
        compose("post-train", PostTrainConfig, ["adapter.rank=-1"])


def test_a_prior_is_named_as_it_was_loaded(tmp_path: Path) -> None:
    base = tiny_prior().save(tmp_path / "base")
    assert ScenePrior.load(base).loaded_as == str(base)
    config = changed(_config(tmp_path / "run", base, iterations=1), {"prior": "dimsum_table_continuous"})
    post_train(config, prior=ScenePrior.load(base))
    assert json.loads((tmp_path / "run" / "adapter.json").read_text())["prior"] == str(base)
    assert ScenePrior.load(tmp_path / "run").card["post_training"]["base"] == "base"
    ScenePrior.load(base, adapter=tmp_path / "run")
    both = ScenePrior.load(base, adapter=f"0.5*{tmp_path / 'run'}")
    assert both.loaded_as == f"{base} with 0.5*{tmp_path / 'run'}"
    post_train(changed(_config(tmp_path / "more", base, iterations=1), {"adapter.rank": 0}), prior=both)
    assert ScenePrior.load(tmp_path / "more").card["post_training"]["base"] == f"base with 0.5*{tmp_path / 'run'}"


def test_a_prior_that_was_not_loaded_has_no_name(tmp_path: Path) -> None:
    post_train(changed(_config(tmp_path / "run", tmp_path, iterations=1), {"adapter.rank": 0}), prior=tiny_prior())
    assert "base" not in ScenePrior.load(tmp_path / "run").card["post_training"]
    base = tiny_prior().save(tmp_path / "base")
    ScenePrior.load(base, adapter=tmp_path / "run")
