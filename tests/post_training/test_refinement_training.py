"""Algorithm ``refinement``: what it trains, which states it keeps, and a run that is resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from agents import ScenePrior
from agents.post_training import PostTrainer, post_train
from agents.post_training.algorithms.guidance_distillation import GuidanceDistillation
from scene_envs.errors import InvalidInputError
from tests.helpers.small_runs import count_objects, small_config

NAME = "refinement"
STEPS = 12


def config(folder: Path, **changes: Any) -> Any:
    algorithm = {"name": NAME, "updates": 2, "states": 16, **changes.pop("algorithm", {})}
    keys = {"reward": count_objects, "num_steps": STEPS, "iterations": 2, "algorithm": algorithm, **changes}
    return small_config(folder, **keys)


def test_only_the_refinement_is_trained_and_sampled_numbers_and_categories_stay(tmp_path: Path) -> None:
    base = ScenePrior.load("dimsum_table")
    result = post_train(config(tmp_path), prior=base)
    trained = ScenePrior.load(tmp_path)
    before, after = base.weights(), trained.weights()
    added = {name for name in after if name not in before}
    assert added
    assert all(name.startswith("refinement.") for name in added)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    plain, refined = (prior.sample(4, num_steps=STEPS, seed=1) for prior in (base, trained))
    assert torch.equal(plain.categories, refined.categories)
    assert not torch.equal(plain.tensor, refined.tensor)
    assert "refinement" not in [module.name for module in base.config.network.modules]  # the caller's prior
    assert [row["correction_mm"] > 0 for row in result.history] == [True, True]


def test_a_resumed_run_equals_the_uninterrupted_one(tmp_path: Path) -> None:
    for folder, iterations in (("whole", 2), ("parts", 1), ("parts", 2)):
        torch.randn(7)  # the global generator has moved on
        post_train(config(tmp_path / folder, iterations=iterations), prior=ScenePrior.load("dimsum_table"))
    whole, parts = (
        torch.load(tmp_path / name / "checkpoint.pt", weights_only=True)["learner"] for name in ("whole", "parts")
    )
    assert all(torch.equal(parts["prior"][name], value) for name, value in whole["prior"].items())
    for name, value in whole["algorithm"]["states"].items():
        assert torch.equal(parts["algorithm"]["states"][name], value)


def test_states_are_those_of_all_steps_at_which_guidance_acts_and_the_oldest_are_forgotten(tmp_path: Path) -> None:
    trainer = PostTrainer(config(tmp_path, algorithm={"memory": 40}), prior=ScenePrior.load("dimsum_table"))
    trainer.prepare()
    algorithm = trainer.learner.algorithm
    assert isinstance(algorithm, GuidanceDistillation)
    size = len(algorithm.steps) * trainer.config.batch_size
    assert 20 < size < 40
    batches = []
    for expected in (size, 40):
        batch, _ = trainer.step()
        batches.append(batch["scene"][:, algorithm.steps].flatten(0, 1))
        states = algorithm.state()["states"]
        assert len(states["scene"]) == expected
    torch.testing.assert_close(states["scene"], torch.cat(batches)[-40:])
    trainer.close()


def test_a_prior_that_can_have_no_refinement_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="refinement needs a mixed flux network"):
        PostTrainer(config(tmp_path), prior=ScenePrior.load("dimsum_table_continuous"))
