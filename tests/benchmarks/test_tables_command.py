"""``python -m benchmarks.paper_tables`` on a handful of scenes: resumed, failing, refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from agents.pretraining.trainer import Pretrainer
from benchmarks.paper_tables.__main__ import main
from benchmarks.paper_tables.data import RowData
from benchmarks.paper_tables.runner import _alone_in
from scene_envs.datasets import generate

pytest.importorskip("pybullet")

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_residual_levels")]
ROWS = ("flux_mixed", "flux_continuous")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Training and held-out scenes."""
    paths = [tmp_path_factory.mktemp(name) for name in ("data", "heldout")]
    for seed, path in enumerate(paths):
        generate("dimsum_table", 12, path, seed=seed, workers=0, verify=False, progress=False)
    return str(paths[0]), str(paths[1])


def tables(folders: tuple[str, str], output: Path, *words: str) -> int:
    data, heldout = folders
    base = [f"data={data}", f"heldout={heldout}", "tables=[objective]", f"rows=[{','.join(ROWS)}]", "size=tiny"]
    return main([*base, "count=4", "workers=0", "pretraining={optimizer: {warmup: 2}}", f"output={output}", *words])


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


def test_scenes_of_another_type_are_refused(
    folders: tuple[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tables(folders, tmp_path, "scene=pantry_shelf") == 2
    assert "holds scenes of 'dimsum_table', not of scene=pantry_shelf" in capsys.readouterr().err
    assert tables(folders, tmp_path, "heldout=") == 2
    assert "too few to compare with; name a folder with more as heldout=" in capsys.readouterr().err
