"""Discriminative regularisation: its gradients at the base prior, its bounds, and runs with it."""

from __future__ import annotations

import csv
import math
from copy import deepcopy
from functools import partial
from pathlib import Path

import pytest
import torch

from agents.post_training import post_train
from agents.post_training.regularisation import DiscriminativeLoss
from agents.post_training.trainer import PostTrainer
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import count_objects, small_config

PROCESSES = ("continuous", "mixed")


def noised_scenes(prior: ScenePrior) -> NoisedScenes:
    scenes = prior.encode(prior.sample(4, num_steps=3, seed=1))
    return prior.noised(scenes, torch.Generator().manual_seed(2))


@pytest.mark.parametrize("process", PROCESSES)
def test_gradients_at_the_base_prior_are_those_of_the_pretraining_loss_and_its_negative(process: str) -> None:
    prior = tiny_prior(process=process)
    parameters = [p.requires_grad_(True) for p in prior.parameters()]
    noised = noised_scenes(prior)
    loss = DiscriminativeLoss(prior, deepcopy(prior), sharpness=20.0)
    pretraining = torch.autograd.grad(prior.noised_loss(noised).mean(), parameters, allow_unused=True)
    for losses, sign in ((loss.of_real, 1.0), (loss.of_base, -1.0)):
        found = torch.autograd.grad(losses(noised).mean(), parameters, allow_unused=True)
        for ours, theirs in zip(found, pretraining, strict=True):
            if theirs is not None:
                torch.testing.assert_close(ours, sign * theirs, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("gap", [-3.0, 0.0, 0.5])
def test_losses_are_those_of_logistic_regression_on_the_gap(gap: float, monkeypatch: pytest.MonkeyPatch) -> None:
    prior = tiny_prior(process="mixed")
    noised = noised_scenes(prior)
    monkeypatch.setattr(DiscriminativeLoss, "gap", lambda self, noised, text=None: torch.full((4,), gap))
    loss = DiscriminativeLoss(prior, prior, sharpness=8.0)
    real, base = (-math.log(1 / (1 + math.exp(-sign * 8.0 * gap))) / 4 for sign in (1, -1))
    torch.testing.assert_close(loss.of_real(noised), torch.full((4,), real))
    torch.testing.assert_close(loss.of_base(noised), torch.full((4,), base))


def test_base_samples_far_from_the_prior_repel_no_more() -> None:
    prior = tiny_prior(process="mixed")
    base = deepcopy(prior)
    for parameter in prior.parameters():
        parameter.requires_grad_(True).data.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator()))
    noised = noised_scenes(base)
    loss = DiscriminativeLoss(prior, base, sharpness=1e4)
    assert bool((loss.gap(noised) < -0.01).all())
    loss.of_base(noised).sum().backward()
    assert max(float(p.grad.abs().max()) for p in prior.parameters() if p.grad is not None) < 1e-6


@pytest.mark.parametrize("process", PROCESSES)
def test_a_run_is_resumed_exactly_and_logs_both_losses(process: str, tmp_path: Path) -> None:
    keys = {
        "reward": count_objects,
        "algorithm": "nft",
        "regularisation.objective": "discriminative",
        "regularisation.weight": 0.5,
        "regularisation.base_samples": 8,
    }
    prior = partial(tiny_prior, process=process, text=process == "mixed")
    for folder, lengths in ((tmp_path / "whole", [3]), (tmp_path / "parts", [2, 3])):
        for iterations in lengths:
            post_train(small_config(folder, **keys, iterations=iterations), prior=prior())
    whole, parts = (ScenePrior.load(tmp_path / name).state_dict() for name in ("whole", "parts"))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    rows = list(csv.DictReader((tmp_path / "whole" / "log.csv").open()))
    assert all(float(row["base_sample_loss"]) > 0 and float(row["base_sample_gradient_norm"]) > 0 for row in rows)


def test_base_samples_are_those_of_the_base_prior_with_the_prompts_of_real_scenes(tmp_path: Path) -> None:
    prior = tiny_prior(process="mixed", text=True)
    config = small_config(
        tmp_path,
        algorithm="nft",
        reward=count_objects,
        **{"regularisation.objective": "discriminative", "regularisation.base_samples": 40},
    )
    trainer = PostTrainer(config, prior=deepcopy(prior))
    trainer.prepare()
    base = trainer.scenes.base
    trainer.close()
    assert base is not None
    assert base.prompts is not None
    known = {text for i in range(len(trainer.scenes.train)) for text in (trainer.scenes.prompts or (lambda i: ()))(i)}
    assert set(base.prompts) - {""} <= known
    assert any(base.prompts)
    saved = SceneBatch.load(tmp_path / "base_samples.safetensors")
    assert len(saved) == len(base.scenes) == 40
    torch.testing.assert_close(prior.encode(saved), base.scenes)
    drawn = base.batch(200, torch.Generator().manual_seed(0))
    pairs = {(scene.numpy().tobytes(), text) for scene, text in zip(base.scenes, base.prompts, strict=True)}
    assert drawn.prompts is not None
    assert {(scene.numpy().tobytes(), text) for scene, text in zip(drawn.scenes, drawn.prompts, strict=True)} <= pairs
