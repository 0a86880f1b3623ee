"""The guard's samples: paired noise, limits, the best checkpoint, rollback, and what the report shows."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from agents.evaluation import tallest_stacks
from agents.evaluation.layouts import count_wasserstein
from agents.post_training import post_train
from agents.post_training.algorithms.forward_process import ForwardProcess
from agents.post_training.guard import Guard, beyond
from agents.post_training.report import write_report
from agents.post_training.settings import GuardSettings
from agents.post_training.trainer import PostTrainer
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType
from tests.helpers.small_runs import small_config

SAMPLES = {"guard.scenes": 20, "guard.samples": 20, "guard.samples_every": 2, "bank_size": 40}


def trainer(path: Path, **changes: object) -> PostTrainer:
    """A prepared run whose base prior has been measured."""
    made = PostTrainer(small_config(path, **(SAMPLES | changes)), prior=tiny_prior())
    made.prepare()
    made.guard.start(made.prior)
    return made


@pytest.mark.slow
def test_the_base_prior_measures_as_itself(tmp_path: Path) -> None:
    """The same prior has the same samples at every check, so nothing exceeds the base prior."""
    guard = trainer(tmp_path, **{"guard.limits.count": 0.0, "guard.limits.classifier": 0.0}).guard
    reading = guard.check(tiny_prior(), 5, reward=0.0)
    assert reading.samples == guard.base_samples
    assert reading.beyond == ()
    assert not reading.kept  # no better than the base prior
    assert guard.last_samples is not None
    assert guard.samples is not None
    assert reading.samples["count_distance"] == count_wasserstein(guard.last_samples, guard.samples.real)


@pytest.mark.slow
def test_samples_of_a_run_have_no_physics_guidance_and_its_prior_keeps_the_strength(tmp_path: Path) -> None:
    logs = []
    for strength in (0.0, 1.0):
        folder = tmp_path / f"{strength:g}"
        config = small_config(folder, iterations=1, algorithm={"name": "nft"}, **SAMPLES)
        post_train(config, prior=tiny_prior(process="mixed").with_physics_guidance(strength))
        assert ScenePrior.load(folder).config.physics_guidance == strength
        with (folder / "log.csv").open() as file:
            logs.append(
                [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
            )
    assert logs[0] == logs[1] != []


@pytest.mark.slow
def test_a_figure_beyond_its_limit_is_named_and_keeps_nothing(tmp_path: Path) -> None:
    made = trainer(tmp_path, **{"guard.limits.count": 1.0})
    other = tiny_prior()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    made.guard.base_samples["count_distance"] = -10.0  # whatever the samples are, they are further than that
    made.guard.best_reward = made.guard.best_score = float("-inf")
    reading = made.guard.check(other, 2, reward=1.0)
    assert "count_distance" in reading.beyond
    assert not reading.kept
    assert made.guard.over_limit_at == 2


def test_a_figure_that_is_not_a_number_is_beyond_its_limit() -> None:
    assert beyond({"category_kl": float("nan")}, {"category_kl": 0.0}, {"category_kl": 1.0}) == ["category_kl"]


def test_checks_of_the_loss_alone_keep_nothing_where_the_guard_samples(tmp_path: Path) -> None:
    guard = trainer(tmp_path).guard
    reading = guard.check(tiny_prior(), 1, reward=1e9, sample=False)
    assert (reading.samples, reading.kept) == ({}, False)


@pytest.mark.slow
def test_rollback_takes_the_best_checkpoint_again(tmp_path: Path) -> None:
    """With no room for the loss, every check returns to the base prior at half the learning rate, four times."""
    config = small_config(
        tmp_path, iterations=30, lr=3e-2, **SAMPLES, **{"guard.limit": 1e-6, "guard.action": "rollback"}
    )
    result = post_train(config, prior=tiny_prior())
    rates = [row["learning_rate"] for row in result.history]
    assert result.metrics["iterations"] == 8
    assert result.metrics["guard"]["rollbacks"] == 4
    assert rates[2] == pytest.approx(rates[1] / 2)
    assert len(SceneBatch.load(tmp_path / "guard_beyond.safetensors")) == 6
    base = tiny_prior().state_dict()
    made = PostTrainer(config, prior=tiny_prior())
    made.learner.return_to(ScenePrior.load(tmp_path / "prior"))
    assert all(torch.equal(base[name], tensor) for name, tensor in made.learner.prior.state_dict().items())


@pytest.mark.slow
def test_a_resumed_run_samples_and_keeps_the_same(tmp_path: Path) -> None:
    keys = {**SAMPLES, "iterations": 3, "algorithm": {"name": "nft", "expectation_lr": 1e-3}}
    whole = post_train(small_config(tmp_path / "a", **keys), prior=tiny_prior())
    half = PostTrainer(small_config(tmp_path / "b", **keys), prior=tiny_prior())
    step, count = half.step, 0

    def interrupted() -> object:
        nonlocal count
        if count == 2:
            raise KeyboardInterrupt
        count += 1
        return step()

    half.step = interrupted  # type: ignore[assignment]
    with pytest.raises(KeyboardInterrupt):
        half.run()
    again = post_train(small_config(tmp_path / "b", **keys), prior=tiny_prior())
    drop = {"seconds"}
    rows = [[{k: v for k, v in row.items() if k not in drop} for row in run.history] for run in (whole, again)]
    assert str(rows[0]) == str(rows[1])
    assert str(whole.metrics["guard"]) == str(again.metrics["guard"])


@pytest.mark.slow
def test_the_report_shows_figures_beside_the_base_prior(tmp_path: Path) -> None:
    config = small_config(tmp_path, iterations=2, **SAMPLES, **{"guard.limits.count": 2.0})
    guard = post_train(config, prior=tiny_prior()).metrics["guard"]
    picture = tmp_path / "a.png"
    Image.new("RGB", (4, 4)).save(picture)

    def page(guard: Mapping[str, Any]) -> str:
        figures = {"scenes": 2.0, "objects": 3.0}
        metrics = {"iterations": 2, "guard": guard, "hold": None, "reward": {"invalid_scenes": 0}}
        return write_report(
            tmp_path / "r.html", "run.html", title="t", reward="count", algorithm="NFT", metrics=metrics,
            before=figures, after=figures, left_out={"feasible": "no"}, rows=[("", "before")], settings="",
            pictures=dict.fromkeys(("curve", "before", "after"), picture),
        ).read_text()  # fmt: skip

    text = page({**guard, "over_optimised_from": None})
    head = "".join(f"<th>{name}</th>" for name in ("", "base prior", "kept prior", "last check", "limit"))
    assert head in text
    assert re.search(r"<td>mean reward</td>(<td>[^<]+</td>){3}<td>kept − 5 standard errors of the difference<", text)
    assert re.search(r"<td>KL divergence of categories \(nats\)</td>(<td>[^<]+</td>){4}</tr>", text)
    assert "The guard found nothing beyond its limits." in text
    check = {"iteration": 5, "beyond": ("category_kl", "loss"), "samples": {}}
    broken = page({**guard, "over_optimised_from": 5, "checks": [check]})
    assert "At iteration 5 the KL divergence of categories (nats) and held-out loss passed the limit" in broken


def test_the_guard_samples_no_more_than_it_compares_with() -> None:
    assert GuardSettings(scenes=64, samples=500).sampled == 64
    assert GuardSettings(scenes=64, samples=19).sampled == 0
    with pytest.raises(InvalidInputError, match="samples=-1"):
        GuardSettings(samples=-1)


def test_a_reward_that_learns_is_judged_by_the_classifier(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reward's own mean falls while the samples become harder to tell from real scenes: the last one is kept."""
    figures = [
        {"sample_reward": reward, "sample_reward_error": 0.01, "count_distance": 0.0, "classifier_accuracy": accuracy}
        for reward, accuracy in ((0.4, 0.9), (0.5, 0.92), (0.3, 0.8))
    ]
    kept = {}
    for learns in (True, False):
        guard = Guard(tiny_prior().initial(2, 34), limit=1.1, seed=0, learns=learns)
        each = iter(figures)
        monkeypatch.setattr(guard, "_measure", lambda prior, sample, each=each: (1.0, next(each)))
        guard.start(tiny_prior())
        kept[learns] = [guard.check(tiny_prior(), iteration, reward=0.0).kept for iteration in (1, 2)]
    assert kept == {True: [False, True], False: [True, False]}


def test_a_mean_reward_below_the_best_checkpoints_is_beyond_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of 0.9 and 0.8 with standard errors of 0.03 and 0.04 differ by two standard errors of their difference."""

    def beyond_limits(limit: float, learns: bool = False, error: float = 0.04) -> list[tuple[str, ...]]:
        guard = Guard(tiny_prior().initial(2, 34), limit=1.1, seed=0, limits={"reward": limit}, learns=learns)
        means = iter([(0.7, 0.03), (0.9, 0.03), (0.8, error)])
        figures = ({"sample_reward": m, "sample_reward_error": e, "classifier_accuracy": 1 - m} for m, e in means)
        monkeypatch.setattr(guard, "_measure", lambda prior, sample: (1.0, next(figures)))
        guard.start(tiny_prior())
        assert ("reward" in guard.summary()["sample_limits"]) is not learns
        return [guard.check(tiny_prior(), iteration, reward=0.0).beyond for iteration in (1, 2)]

    assert beyond_limits(1.99) == [(), ("reward",)]
    assert beyond_limits(2.01) == [(), ()]
    assert beyond_limits(1.99, learns=True) == [(), ()]
    assert beyond_limits(1.99, error=float("nan")) == [(), ()]


def test_a_run_whose_reward_falls_returns_to_its_best_checkpoint(tmp_path: Path) -> None:
    checks = 0

    def falling(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """From 0 to 1 over the samples of the base prior, and ten less at each check from the second on."""
        nonlocal checks
        checks += len(batch) == 20
        return RewardOutput(torch.linspace(0.0, 1.0, len(batch)) - (10.0 if checks > 2 else 0.0))

    keys = {"reward": falling, "iterations": 3, "guard.every": 1, "guard.samples_every": 1, "guard.action": "rollback"}
    guard = post_train(small_config(tmp_path, **SAMPLES | keys), prior=tiny_prior()).metrics["guard"]
    assert [check["beyond"] for check in guard["checks"]] == [(), ("reward",), ("reward",)]
    assert (guard["rollbacks"], guard["best_iteration"], guard["over_optimised_from"]) == (2, 0, 2)


def test_a_check_compares_stacks_with_those_of_real_scenes(tmp_path: Path) -> None:
    """Real scenes have their own stacks, and scenes of single objects lower ones."""
    check = trainer(tmp_path).guard.samples
    assert check is not None
    assert check.figures(check.real)["stack_distance"] == 0.0
    table = SceneBatch.empty("dimsum_table", len(check.real))
    assert check.figures(table)["stack_distance"] == pytest.approx(float(tallest_stacks(check.real).double().mean()))


def test_a_limit_on_stacks_needs_geometry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SceneType, "has_geometry", property(lambda self: False))
    with pytest.raises(InvalidInputError, match=r"guard\.limits\.stack=0\.5 needs the geometry"):
        trainer(tmp_path, **{"guard.limits.stack": 0.5})


def test_a_figure_that_the_base_prior_lacks_is_within_its_limit() -> None:
    assert beyond({"stack_distance": 3.0}, {}, {"stack_distance": 0.5}) == []


@pytest.mark.slow
def test_a_rollback_takes_every_part_of_the_algorithm_back(tmp_path: Path) -> None:
    """The copy that learns the mean of own samples belongs to the policy that made them."""
    keys = {"algorithm": {"name": "nft", "expectation_lr": 1e-2}, "guard.limit": 1e-6, "guard.action": "rollback"}
    trainer = PostTrainer(small_config(tmp_path, **keys), prior=tiny_prior(process="mixed"))
    trainer.run()
    algorithm = trainer.learner.algorithm
    assert isinstance(algorithm, ForwardProcess)
    assert algorithm.expectation is not None
    base = tiny_prior(process="mixed").state_dict()
    for prior in (trainer.prior, algorithm.sampler, algorithm.expectation.prior):
        assert all(torch.equal(base[name], tensor) for name, tensor in prior.state_dict().items())
    assert not algorithm.expectation.optimizer.state
    trainer.close()


@pytest.mark.slow
def test_figures_of_the_base_prior_are_not_those_of_the_kept_one(tmp_path: Path) -> None:
    prior = tiny_prior()
    prior.card = {"measures": {"feasible_fraction": 0.8}, "limits": "None.", "license": "MIT"}
    result = post_train(small_config(tmp_path, iterations=2), prior=prior)
    assert result.metrics["guard"]["best_iteration"] > 0
    card = ScenePrior.load(tmp_path).card
    assert card["license"] == "MIT"
    assert not {"measures", "limits"} & card.keys()
