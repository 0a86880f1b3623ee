"""Rows, sizes, cells and pages of the tables, without training."""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from pathlib import Path

import pytest

from agents.configuration.composition import dotted_values
from agents.pretraining.settings import PretrainConfig
from benchmarks.paper_tables import ALL_TABLES, Entry, Row, Table, TablesConfig, list_rows, make_tables
from benchmarks.paper_tables.columns import COLUMNS, Column, error, expand, text
from benchmarks.paper_tables.plot import draw
from benchmarks.paper_tables.rows import PAPER
from benchmarks.paper_tables.tables import FilledTable, Line, csv_text, markdown, markdown_table
from benchmarks.paper_tables.training import match_width, run_config, target_parameters
from scene_envs.errors import InvalidInputError, UnknownNameError

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
    assert {("process.schedule", name) for name in ("linear", "cosine", "karras")} <= asked
    assert {("process.moments", name) for name in ("scene", "feature", "category")} <= asked
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
        pretraining={"network": {"depth": 3}, "process.schedule": "cosine"},
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
