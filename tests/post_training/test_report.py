"""The doctor's screen, the page about a run, and the demonstration from end to end."""

from __future__ import annotations

import html
import itertools
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from agents.post_training import doctor, post_train_and_compare
from agents.post_training import learner as learned_rewards
from agents.post_training.demo import run_demo
from agents.post_training.doctor import diagnose
from agents.post_training.report import load_learned_rewards, measure_prior, write_report
from agents.post_training.run_files import draw_curve
from agents.post_training.trainer import post_train
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import make_reward
from rewards.base import RewardContext, RewardOutput
from scene_envs.errors import TrainingError
from scene_envs.files import read_sealed
from scene_envs.scene import SceneBatch
from tests.helpers.simulators import no_simulator
from tests.helpers.small_runs import count_objects, small_config


def test_doctor_finds_nothing_wrong_with_log_ratio_and_writes_nothing(tmp_path: Path) -> None:
    config = small_config(tmp_path / "run")
    report = diagnose(config, prior=tiny_prior())
    assert report.log_ratio == 0.0
    assert len(report.steps) == 3
    assert report.steps[-1].std == 0.0
    assert report.steps[-1].weight == 0.0
    assert all(row.gradient_norm > 0 for row in report.steps if row.weight > 0)
    assert report.reward_min <= report.reward_mean <= report.reward_max
    assert not (tmp_path / "run").exists()
    json.dumps(report.metrics())


def test_doctor_says_when_there_is_nothing_to_learn_from(tmp_path: Path) -> None:
    def flat(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        return RewardOutput(0.0 * count_objects(batch, context).value)

    report = diagnose(small_config(tmp_path / "run", reward=flat), prior=tiny_prior())
    assert report.advice
    assert any("nothing to learn" in line for line in report.advice)


def test_doctor_says_when_regularisation_is_too_loud(tmp_path: Path) -> None:
    report = diagnose(small_config(tmp_path / "run", regularisation=1e6), prior=tiny_prior())
    assert any("lower regularisation" in line for line in report.advice)


def test_doctor_fits_one_screen(tmp_path: Path) -> None:
    report = diagnose(small_config(tmp_path / "run", num_steps=25), prior=tiny_prior())
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(report)
    text = console.export_text()
    assert len(text.splitlines()) <= 40
    assert "log-ratio at the start" in text


def test_page_needs_nothing_but_itself_and_escapes_text(tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(picture)
    figures = {name: {"scenes": 2.0, "objects": 3.0} for name in ("base", "<b>")}
    run = SimpleNamespace(
        goal="a & b", algorithm="NFT", curve=picture, metrics={"iterations": 1, "guard": {"ratio": 1}}
    )
    text = write_report(
        tmp_path / "r.html", "demo.html", title="<t>", runs={"<b>": run}, figures_of=figures, count=2,
        left_out={"feasible": "no"}, pictures={"samples": picture}, rows=[("x", "y"), ("1", "<2>")],
        settings="k: <v>",
    ).read_text()  # fmt: skip
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", text)
    assert "http" not in text
    assert "<script" not in text
    assert text.count("data:image/png;base64,") == 2
    assert all(escaped in text for escaped in ("&lt;t&gt;", "&lt;b&gt;", "a &amp; b", "&lt;2&gt;", "&lt;v&gt;"))


@pytest.mark.slow
def test_report_and_metrics_have_the_trained_reward_before_and_after(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")

    def squared_count(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """A reward that no other figure of the report is equal to; it cannot score the second of three scenes."""
        valid = torch.arange(len(batch)) != 1 if len(batch) == 3 else None
        return RewardOutput(batch.counts.float() ** 2, valid=valid)

    prior = tiny_prior(slots=6)
    config = small_config(tmp_path, iterations=1, reward=squared_count)
    metrics = post_train_and_compare(config, scenes=3, num_steps=4, prior=prior)
    on_disk = json.loads((tmp_path / "metrics.json").read_text())
    for when, measured in (("before", prior), ("after", ScenePrior.load(tmp_path))):
        squares = measured.sample(3, num_steps=4, seed=100_000).counts.double()[[0, 2]] ** 2
        assert on_disk[when]["reward"] == pytest.approx(float(squares.mean()))
        assert on_disk[when]["reward_invalid"] == 1
    assert on_disk["change"]["reward"] == pytest.approx(metrics["after"]["reward"] / metrics["before"]["reward"] - 1)
    page = (tmp_path / "report.html").read_text()
    assert "reward: squared count" in page
    assert "the trained reward" in page
    assert f"{metrics['after']['reward']:.2f}" in page
    shown = html.unescape(page.partition('<pre class="scroll">')[2].partition("</pre>")[0])
    assert shown == read_sealed(tmp_path / "config.yaml")  # the settings as --config reads them


@pytest.mark.slow
def test_a_report_without_a_simulator_says_what_it_leaves_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    no_simulator(monkeypatch)
    config = small_config(tmp_path, iterations=1)
    post_train_and_compare(config, scenes=3, num_steps=4, prior=tiny_prior(slots=6))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["left_out"] == {"feasible": "no simulator here"}
    for when in ("before", "after"):
        assert {"reward", "objects"} <= set(metrics[when])
        assert not {"feasible_objects", "ready_objects", "invalid_scenes"} & set(metrics[when])
    page = (tmp_path / "report.html").read_text()
    assert "Left out: no simulator here." in page
    assert not (tmp_path / "after_ready.png").exists()
    parts = {"base": measure_prior(tiny_prior(slots=6), 2, num_steps=2)}
    assert (parts["base"].ready, parts["base"].is_ready) == (None, None)


@pytest.mark.slow
def test_demonstration_end_to_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("scene_envs.physics")
    small = [f"prior={tiny_prior(slots=6).save(tmp_path / 'base')}", "batch_size=4", "num_steps=3", "iterations=1",
             "regularisation.bank_size=20", "regularisation.batch_size=4", "guard.scenes=8"]  # fmt: skip
    runs = {"clutter": small, "feasible": [*small, "algorithm=nft", "reward=feasible_share"]}
    folder, wrong = tmp_path / "demo", [*small, "algorithm=ntf"]
    with pytest.raises(TrainingError, match="the run 'feasible' ended with status 2"):
        run_demo(folder, workers=0, scenes=2, num_steps=4, runs={**runs, "feasible": wrong})
    assert "feasible: scene-envs: unknown" in capfd.readouterr().err
    metrics = run_demo(folder, workers=0, scenes=2, num_steps=4, runs=runs)
    on_disk = json.loads((folder / "metrics.json").read_text())
    assert on_disk["runs"]["clutter"]["guard"]["ratio"] == metrics["runs"]["clutter"]["guard"]["ratio"]
    priors = {"base": tiny_prior(slots=6), **{name: ScenePrior.load(folder / name) for name in runs}}
    for name, prior in priors.items():
        assert {"objects", "feasible_objects", "ready_objects"} <= on_disk[name].keys()
        counts = prior.sample(2, num_steps=4, seed=100_000).counts.float()
        assert on_disk[name]["objects"] == pytest.approx(float(counts.mean()))
    for name in ("report.html", "samples.png", "ready.png", "clutter/curve.png", "feasible/log.csv"):
        assert (folder / name).stat().st_size > 0


def test_the_band_of_a_share_ends_at_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.axes import Axes

    bands: list[tuple[list[float], list[float]]] = []

    def noted(self: Axes, x: Any, low: Any, high: Any, **_: Any) -> None:
        bands.append((low.tolist(), high.tolist()))

    monkeypatch.setattr(Axes, "fill_between", noted)
    history = [
        {"iteration": 1.0, "reward": 0.75, "reward_std": 0.5},
        {"iteration": 2.0, "reward": 0.5, "reward_std": 0.25},
    ]
    draw_curve(history, tmp_path / "curve.png", reward_name="share", highest=1.0)
    draw_curve(history, tmp_path / "curve.png", reward_name="sum")
    assert bands == [([0.25, 0.25], [1.0, 0.75]), ([0.25, 0.25], [1.25, 0.75])]


def test_a_reward_that_learns_is_measured_as_the_run_left_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_rewards, "FIRST_STEPS", 5)
    judge = {"name": "discriminator", "steps": 3, "batch_size": 12}
    config = small_config(tmp_path, iterations=1, reward=judge, algorithm={"name": "nft"})
    prior = tiny_prior(process="mixed", slots=6)
    post_train(config, prior=prior)
    reward, batch = make_reward("discriminator"), prior.sample(3, num_steps=4)
    load_learned_rewards(reward, tmp_path, config.guard.scenes, config.seed)
    assert bool((reward(batch, RewardContext()).value != 0.5).all())  # that of a network that has seen no samples


def test_doctor_says_when_no_advantage_differs(tmp_path: Path) -> None:
    keys = {"algorithm": {"name": "nft", "category_credit": "none"}, "reward": "object_count"}
    report = diagnose(small_config(tmp_path / "run", **keys), prior=tiny_prior(process="mixed"))
    assert report.reward_std > 0
    assert any("no advantage does" in line for line in report.advice)


def test_doctor_asks_nothing_of_the_reward_of_an_algorithm_that_does_not_use_it(tmp_path: Path) -> None:
    algorithm = {"name": "guidance_distillation", "states": 8}
    config = small_config(
        tmp_path / "run", algorithm=algorithm, reward=lambda batch: RewardOutput(torch.ones(len(batch)))
    )
    report = diagnose(config, prior=tiny_prior(process="mixed", slots=8))
    assert report.reward_std == 0
    assert not any("nothing to learn" in line for line in report.advice)


def test_the_length_of_a_run_counts_all_updates_of_a_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a clock that goes on by one second whenever it is read, a batch takes one, and each of five updates one."""
    seconds = itertools.count(0.0)
    monkeypatch.setattr(doctor, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    keys = {"algorithm": {"name": "nft", "updates": 5}, "iterations": 10}
    report = diagnose(small_config(tmp_path / "run", **keys), prior=tiny_prior(process="mixed"))
    assert (report.sampling_seconds, report.update_seconds) == (1.0, 5.0)
