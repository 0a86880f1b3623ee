"""Progress of ``scene-envs search`` where stderr is no terminal: a line for the search and one for best-of-N."""

from __future__ import annotations

from pathlib import Path

import pytest

from agents.cli import main
from agents.priors.testing import tiny_prior


@pytest.mark.slow
def test_search_and_baseline_have_a_last_line_with_the_scenes_and_evaluations(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    prior = tiny_prior("dimsum_table", process="mixed", slots=6).save(tmp_path / "prior")
    words = ["objective=object_count", "planner=greedy", "budget=6", "branching=2", "num_steps=2", "slots=6"]
    assert main(["search", f"prior={prior}", *words, f"output={tmp_path / 'found'}"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if " scenes, best " in line]
    assert [line.split(":")[0] for line in lines] == ["search", "best of N"]
    assert all("6/6 scenes, best 0." in line or "6/6 scenes, best 1." in line for line in lines)
    assert all(line.endswith("12 NFE") for line in lines)
