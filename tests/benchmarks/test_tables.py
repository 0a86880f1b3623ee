"""Rows, sizes, cells and pages of the tables, without training."""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from pathlib import Path

import pytest

from agents.cli.keys import compose
from agents.configuration.composition import dotted_values
from agents.post_training.settings import PostTrainConfig
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import Pretrainer
from benchmarks.paper_tables import ALL_TABLES, Entry, Row, Table, TablesConfig, list_rows, make_tables
from benchmarks.paper_tables.__main__ import main
from benchmarks.paper_tables.columns import COLUMNS, Column, error, expand, text
from benchmarks.paper_tables.data import RowData
from benchmarks.paper_tables.plot import draw
from benchmarks.paper_tables.rows import PAPER
from benchmarks.paper_tables.runner import _alone_in
from benchmarks.paper_tables.tables import FilledTable, Line, csv_text, markdown, markdown_table
from benchmarks.paper_tables.training import match_width, run_config, target_parameters
from benchmarks.post_training.__main__ import main as post_training_main
from benchmarks.post_training.rows import TABLES
from benchmarks.post_training.runs import guard_figures, measure, training_figures
from rewards.registry import allow_local_rewards, local_files, resolve_reward
from scene_envs.datasets import generate
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.registry import run_file

STANDARD = dotted_values(PretrainConfig())


def filled(*lines: Line, columns: tuple[str, ...] = ("feasible_fraction", "category_kl")) -> FilledTable:
    entries = tuple(Entry(line.label, Row(line.row)) for line in lines)
    return FilledTable(Table("unconditional", "A title", "", entries, columns, columns), lines, "A note.")


def test_a_name_stands_for_one_training_run() -> None:
    runs = defaultdict(set)
    for table in make_tables():
        for entry in table.entries:
            runs[entry.row.name].add((tuple(sorted(entry.row.overrides.items())), entry.row.capacity))
    assert all(len(found) == 1 for found in runs.values())
    assert all(key in STANDARD for found in runs.values() for overrides, _ in found for key, _ in overrides)
    assert len({frozenset(found) for found in runs.values()}) == len(runs)


def test_tables_share_runs() -> None:
    tables = {table.name: {entry.row.name for entry in table.entries} for table in make_tables()}
    assert tuple(tables) == ALL_TABLES
    assert tables["conditional"] < tables["unconditional"]
    assert "flux_continuous" in tables["objective"] & tables["rotation"]
    assert "flux_mixed" in tables["objective"] & tables["precision"]


def test_every_precision_row_changes_one_thing_of_the_first_of_its_part() -> None:
    base: dict[str, object] = {}
    group = ""
    for entry in make_tables(["precision"])[0].entries:
        whole = {**STANDARD, **entry.row.overrides}
        if entry.group != group:
            base, group = whole, entry.group
            assert entry.row.capacity == 1
            continue
        changed = {key for key in whole if whole[key] != base[key]}
        if entry.row.capacity != 1:
            assert not changed
        else:
            together = (
                {"process.prediction", "loss.weighting"},
                {"process.kernel", "loss.category", "process.empty_slots"},
            )
            assert len(changed) == 1 or any(changed <= keys for keys in together), changed


def test_every_factor_is_asked() -> None:
    ours = [entry.row for entry in make_tables(["precision"])[0].entries if entry.row.name.startswith("flux_mixed")]
    asked = {(key, value) for row in ours for key, value in row.overrides.items()} | {
        (key, value) for key, value in STANDARD.items() if isinstance(value, str | int | float)
    }
    assert {("process.prediction", name) for name in ("epsilon", "v", "x0", "edm")} <= asked
    assert {("process.schedule", name) for name in ("linear", "karras")} <= asked
    assert {("process.moments", name) for name in ("feature", "category")} <= asked
    assert {("process.noise.floor", value) for value in (0.01, 0.002, 0.0005)} <= asked
    assert {("loss.translation_weight", 1.0), ("loss.translation_weight", 3.0)} <= asked
    assert {("optimizer.rate.final", 1.0), ("optimizer.rate.decay", 1.0)} <= asked
    assert {("network.modules.rotation_features", True), ("network.modules.rotation_features", False)} <= asked
    assert {
        *(("network.modules.relations", name) for name in ("none", "largest", "axis")),
        ("network.flux.frequencies", 0),
        ("network.flux.frequencies", 8),
    } <= asked
    assert {row.capacity for row in ours} == {0.5, 1.0, 2.0}
    assert [entry.row.overrides for entry in make_tables(["precision"], ["paper"])[0].entries] == [PAPER]


def test_rows_are_chosen_by_pattern() -> None:
    tables = make_tables(["rotation", "objective"], ["*quaternion", "flux_mixed"])
    assert [row.name for row in list_rows(tables)] == ["flux_mixed", "flux_continuous_quaternion"]
    with pytest.raises(InvalidInputError, match="'flux_mxed' matches no row of these tables; known: flux_mixed,"):
        make_tables(["objective"], ["flux_mxed"])


def test_keys_of_a_row_win_over_those_of_all_rows(tmp_path: Path) -> None:
    settings = TablesConfig(
        size="tiny",
        iterations=7,
        pretraining={"network": {"depth": 3}, "process.schedule": "karras"},
        output=str(tmp_path),
    )
    config = run_config(Row("one", {"process.schedule": "linear"}), settings)
    assert (config.process.schedule, config.network.depth, config.iterations, config.batch_size) == ("linear", 3, 7, 4)
    assert config.output == str(tmp_path / "runs" / "one")
    assert target_parameters(Row("two", capacity=2.0), settings) == 120_000
    with pytest.raises(UnknownNameError, match=r"did you mean 'process\.schedule'"):
        run_config(Row("one", {"process.shedule": "linear"}), settings)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"size": "smal"}, "did you mean 'small'"),
        ({"tables": ["precison"]}, "did you mean 'precision'"),
        ({"tables": []}, "asks for nothing"),
        ({"iterations": 0}, "iterations=0 must be at least 1"),
        ({"count": 1}, "measure at least 2"),
        ({"pretraining": "hidden"}, "is no mapping"),
        ({"pretraining": {"recipe": "paper", "network.hidden": 8}}, r"cannot set recipe \(it is a set of keys"),
        ({"pretraining": {"iterations": 5}}, r"cannot set iterations \(a key of tables itself"),
    ],
)
def test_wrong_settings_are_refused(keys: dict[str, object], message: str) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=message):
        TablesConfig(**keys)  # type: ignore[arg-type]


def test_the_nearest_width_is_found() -> None:
    def cubic(width: int) -> int:
        return width**3 + 11 * width

    for target in (10, 5_000, 123_456, 7_654_321):
        best = min(range(3, 300, 3), key=lambda width: abs(cubic(width) - target))
        assert match_width(target, 3, cubic) == best


def test_errors_of_shares_are_binomial() -> None:
    share = COLUMNS["feasible_fraction"]
    assert error(share, {"feasible_fraction": 0.2, "free_objects": 400.0}) == pytest.approx(2.0)
    assert error(share, {"feasible_fraction": 1.0, "free_objects": 400.0}) is None
    assert text(share, {"feasible_fraction": 0.2, "free_objects": 400.0}) == "20.0 ± 2.0"
    assert text(share, {"feasible_fraction": 0.2}) == "20.0"
    assert text(share, {}) == text(share, {"feasible_fraction": None}) == ""
    accuracy = {"classifier_accuracy": 0.61, "classifier_accuracy_std": 0.0125}
    assert text(COLUMNS["classifier_accuracy"], accuracy) == "61.0 ± 1.2"
    assert text(COLUMNS["category_kl"], {"category_kl": 0.00123}) == "12.3"


def test_columns_without_numbers_are_left_out() -> None:
    figures = {"height_error_stack_mm": 1.0, "height_error_stack_p95_mm": 2.0, "feasible_fraction": 0.5}
    names = [column.name for column in expand(["height_errors", "category_kl", "feasible_fraction"], [{}, figures])]
    assert names == ["height_error_stack_mm", "height_error_stack_p95_mm", "feasible_fraction"]
    with pytest.raises(UnknownNameError, match="did you mean 'category_kl'"):
        expand(["category_kll"], [figures])


def test_pages_show_all_lines_failures_included() -> None:
    good = Line("good", "a", "", {"feasible_fraction": 0.25, "free_objects": 300.0, "category_kl": 0.01})
    bad = Line("bad", "b", "", {}, "out of memory |\nhalf way")
    real = Line("real", "", "", {"feasible_fraction": 1.0, "free_objects": 300.0, "category_kl": 0.0001})
    table = filled(good, bad, real)
    assert markdown_table(table).splitlines() == [
        "|  | feasible objects % | category KL ×10⁴ |",
        "|---|---|---|",
        "| good | 25.0 ± 2.5 | 100 |",
        "| bad | failed: out of memory \\| half way |  |",
        "| real | 100 | 1.00 |",
    ]
    page = markdown([table], "Priors", "Of all.")
    assert page.startswith("# Priors\n\nOf all.\n\n## A title\n\nA note.\n\n| ")
    rows = list(csv.DictReader(io.StringIO(csv_text([table]))))
    assert [row["label"] for row in rows] == ["good", "bad", "real"]
    assert float(rows[0]["feasible_fraction"]) == 0.25
    assert float(rows[0]["feasible_fraction_error"]) == pytest.approx(0.025)
    assert float(rows[2]["category_kl"]) == pytest.approx(0.0001)
    assert rows[1]["failure"] == bad.failure
    assert rows[1]["feasible_fraction"] == ""


def test_the_picture_needs_a_number(tmp_path: Path) -> None:
    nothing = filled(Line("bad", "b", "", {}, "failed"), Line("real", "", "", {}))
    assert draw([nothing], tmp_path / "plot.png") is None
    good = Line("good", "a", "", {"feasible_fraction": 0.25, "category_kl": 0.01})
    path = draw([nothing, filled(good, *nothing.lines)], tmp_path / "plot.png")
    assert path is not None
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_column_has_one_meaning() -> None:
    known = {*COLUMNS, "height_errors"}
    for table in make_tables():
        assert set(table.columns) | set(table.plotted) <= known
        assert len(set(table.columns)) == len(table.columns)
    assert all(isinstance(column, Column) and column.name == name for name, column in COLUMNS.items())


ROWS = ("flux_mixed", "flux_continuous")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Training and held-out scenes."""
    pytest.importorskip("pybullet")
    paths = [tmp_path_factory.mktemp(name) for name in ("data", "heldout")]
    for seed, path in enumerate(paths):
        generate("dimsum_table", 12, path, seed=seed, workers=0, verify=False, progress=False)
    return str(paths[0]), str(paths[1])


def tables(folders: tuple[str, str], output: Path, *words: str) -> int:
    data, heldout = folders
    base = [f"data={data}", f"heldout={heldout}", "tables=[objective]", f"rows=[{','.join(ROWS)}]", "size=tiny"]
    return main(
        [*base, "count=4", "workers=0", "pretraining={optimizer: {rate: {warmup: 2}}}", f"output={output}", *words]
    )


def records(output: Path) -> list[dict[str, str]]:
    """Lines of the CSV file without what the clock says."""
    with (output / "tables.csv").open(encoding="utf-8", newline="") as file:
        return [{key: value for key, value in row.items() if key != "seconds_per_step"} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def whole(folders: tuple[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output of a run that nothing stopped."""
    output = tmp_path_factory.mktemp("whole")
    assert tables(folders, output) == 0
    return output


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_it_writes_every_row_and_the_real_scenes(whole: Path) -> None:
    found = records(whole)
    assert [row["row"] for row in found] == [*ROWS, ""]
    assert found[-1]["label"] == "real"
    assert float(found[-1]["feasible_fraction"]) > 0.9
    page = (whole / "tables.md").read_text(encoding="utf-8")
    assert all(f"\n| {row['label']} | " in page for row in found)
    assert (whole / "plot.png").stat().st_size > 5000
    first, second = (float(row["parameters"]) for row in found[:2])
    assert first == pytest.approx(60_000, rel=0.1)
    assert second == pytest.approx(60_000, rel=0.1)
    metrics = json.loads((whole / "metrics.json").read_text())
    assert set(metrics["rows"]) == set(ROWS)
    assert not metrics["failed"]
    assert not (whole / "runs" / ROWS[0] / "checkpoint.pt").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_killed_and_resumed_it_gives_the_same_tables(
    folders: tuple[str, str], whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update = Pretrainer._update

    def dies(self: Pretrainer) -> tuple[float, float]:
        if ROWS[1] in self.config.output and self.step == 2:
            raise KeyboardInterrupt
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(Pretrainer, "_update", dies)
        assert tables(folders, tmp_path) == 130
    assert not any(row["failure"] for row in records(tmp_path))
    assert (tmp_path / "tables.md").read_text(encoding="utf-8").count("| not run yet |") == 1
    steps: list[str] = []

    def counted(self: Pretrainer) -> tuple[float, float]:
        steps.append(f"{Path(self.config.output).name} {self.step}")
        return update(self)

    monkeypatch.setattr(Pretrainer, "_update", counted)
    assert tables(folders, tmp_path) == 0
    assert steps == [f"{ROWS[1]} 2"]
    assert records(tmp_path) == records(whole)


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_a_failing_row_is_told_and_the_rest_goes_on(
    folders: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    prepare = RowData.prepare

    def fails(self: RowData, config: object) -> object:
        if ROWS[0] in config.output:  # type: ignore[attr-defined]
            raise RuntimeError("no room on the device")
        return prepare(self, config)  # type: ignore[arg-type]

    monkeypatch.setattr(RowData, "prepare", fails)
    assert tables(folders, tmp_path) == 1
    assert f"1 of 2 rows failed: {ROWS[0]}" in capsys.readouterr().err
    bad, good, _ = records(tmp_path)
    assert bad["failure"] == "RuntimeError: no room on the device"
    assert not bad["category_kl"]
    assert float(good["category_kl"]) >= 0
    assert "failed: RuntimeError: no room on the device" in (tmp_path / "tables.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_other_keys_in_the_same_folder_are_refused(
    folders: tuple[str, str], whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = records(whole)
    assert tables(folders, whole, "iterations=5") == 2
    assert "iterations was 3, is 5" in capsys.readouterr().err
    with _alone_in(whole):
        assert tables(folders, whole) == 2
    assert "another command is making tables in" in capsys.readouterr().err
    assert records(whole) == before


@pytest.mark.slow
@pytest.mark.usefixtures("few_residual_levels")
def test_scenes_of_another_type_are_refused(
    folders: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tables(folders, tmp_path, "scene=pantry_shelf") == 2
    assert "holds scenes of 'dimsum_table', not of scene=pantry_shelf" in capsys.readouterr().err
    assert tables(folders, tmp_path, "heldout=") == 2
    assert "too few to compare with; name a folder with more as heldout=" in capsys.readouterr().err


@pytest.mark.slow
def test_every_kind_of_row_is_a_valid_run() -> None:
    kinds = {}
    for table in TABLES.values():
        names = [row.name for row in table.rows]
        assert len(names) == len(set(names))
        kinds |= {tuple(key for key in row.keys if not key.startswith("seed=")): row for row in table.rows}
    for row in kinds.values():
        words = [f"prior={row.prior}", *row.keys, f"iterations={row.iterations}"]
        algorithm, _, name = row.keys[0].partition(".py:")
        if name:  # of a file, which the command runs
            run_file(Path(f"{algorithm.removeprefix('algorithm=')}.py"))
            words[1] = f"algorithm={name}"
        reward = compose("post-train", PostTrainConfig, words).reward
        for path in local_files(reward):
            allow_local_rewards(path)
        resolve_reward(reward)


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
            json.dumps({"free_objects_mean": 17.0, "evaluation": {"groups": groups, "left_out": {"physics": ""}}})
        )
        return 0

    monkeypatch.setattr("benchmarks.post_training.runs.scene_envs", evaluate)
    path.write_text(json.dumps({"num_steps": 50.0, "evaluation": {"groups": {}, "left_out": {}}}))
    for _ in range(2):
        assert measure("dimsum_table", tmp_path, ("layout", "physics"), 8) == {"free_objects_mean": 17.0}
    assert len(calls) == 1


@pytest.mark.parametrize("word", ["table=placements", "rows=[dimsum-*]"])
def test_unknown_tables_and_rows_name_the_known_ones(
    word: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert post_training_main([word, f"output={tmp_path}"]) == 2
    message = capsys.readouterr().err
    assert word.partition("=")[2].strip("[]") in message
    assert "placement" in message or "dimsum_table-nft-0" in message
