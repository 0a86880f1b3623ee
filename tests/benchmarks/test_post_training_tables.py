"""The tables of post-training: their keys are those of the command, and their figures follow from the log."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agents.cli.keys import compose
from agents.post_training.settings import PostTrainConfig
from benchmarks.post_training.__main__ import main
from benchmarks.post_training.rows import TABLES
from benchmarks.post_training.runs import guard_figures, measure, training_figures
from rewards.registry import resolve_reward


@pytest.mark.slow
@pytest.mark.parametrize("table", sorted(TABLES))
def test_every_kind_of_row_is_a_valid_run(table: str) -> None:
    names = [row.name for row in TABLES[table].rows]
    assert len(names) == len(set(names))
    kinds = {tuple(key for key in row.keys if not key.startswith("seed=")): row for row in TABLES[table].rows}
    for row in kinds.values():
        words = [f"prior={row.prior}", *row.keys, f"iterations={row.iterations}"]
        resolve_reward(compose("post-train", PostTrainConfig, words).reward)


def test_the_largest_fall_is_measured_from_the_best_mean_before_it(tmp_path: Path) -> None:
    means = [0.7, 0.9, 0.8, 0.85, 0.95, 0.94]
    lines = ["iteration,reward,seconds,guard_ratio"]
    for window, mean in enumerate(means):
        for place in range(20):
            lines.append(f"{20 * window + place + 1},{mean + (0.01 if place % 2 else -0.01)},{window},1.0{window}")
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    figures = training_figures(tmp_path)
    assert figures["fall"] == pytest.approx(0.1)
    assert (figures["first"], figures["best"], figures["last"]) == pytest.approx((0.7, 0.95, 0.94))
    assert figures["loss"] == 1.05


def test_the_figures_of_the_guard_are_those_of_its_last_check(tmp_path: Path) -> None:
    assert guard_figures(tmp_path) == {}
    sampled = [
        {"sample_reward": reward, "count_distance": 1.0 + reward, "classifier_accuracy": 0.9 - reward}
        for reward in (0.5, 0.6, 0.7)
    ]
    checks = [{"iteration": 20 * i, "samples": figures} for i, figures in enumerate(sampled[1:], start=1)]
    guard = {"best_iteration": 20, "base_samples": sampled[0], "checks": checks}
    (tmp_path / "metrics.json").write_text(json.dumps({"guard": guard}))
    figures = guard_figures(tmp_path)
    assert (figures["base_reward"], figures["guard_reward"], figures["kept"]) == (0.5, 0.7, 20.0)
    assert figures["guard_counts"] == 1.7
    assert figures["base_classifier"] - figures["guard_classifier"] == pytest.approx(0.2)
    (tmp_path / "metrics.json").write_text(json.dumps({"guard": None}))
    assert guard_figures(tmp_path) == {}


def test_an_interrupted_evaluation_goes_on_and_a_finished_one_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, calls = tmp_path / "metrics.json", []

    def evaluate(words: tuple[str, ...]) -> int:
        calls.append(words)
        groups = {"layout": {"free_objects_mean": 17.0}}
        path.write_text(
            json.dumps({"free_objects_mean": 17.0, "evaluation": {"groups": groups, "skipped": {"physics": ""}}})
        )
        return 0

    monkeypatch.setattr("benchmarks.post_training.runs.scene_envs", evaluate)
    path.write_text(json.dumps({"num_steps": 50.0, "evaluation": {"groups": {}, "skipped": {}}}))
    for _ in range(2):
        assert measure("dimsum_table", tmp_path, ("layout", "physics"), 8) == {"free_objects_mean": 17.0}
    assert len(calls) == 1


@pytest.mark.parametrize("word", ["table=placements", "rows=[dimsum-*]"])
def test_unknown_tables_and_rows_name_the_known_ones(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word, f"output={tmp_path}"]) == 2
    message = capsys.readouterr().err
    assert word.partition("=")[2].strip("[]") in message
    assert "placement" in message or "dimsum_table-nft-0" in message
