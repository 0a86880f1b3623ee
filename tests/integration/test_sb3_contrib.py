"""Training of MaskablePPO of sb3-contrib in the search environment with a choice of masks."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")


@pytest.mark.slow
def test_the_example_trains_and_compares_at_equal_nfe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(__file__).parents[2] / "examples" / "maskable_ppo.py"
    spec = importlib.util.spec_from_file_location("maskable_ppo_example", path)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, example)
    spec.loader.exec_module(example)
    monkeypatch.setattr(example, "MASKS", [{"name": "empty", "count": 4}, "random"])  # which need no physics
    monkeypatch.setattr(sys, "argv", ["maskable_ppo.py", "--smoke", "--objective", "object_count"])
    rows = example.main(example.parse_args())
    assert next(iter(rows)) == "one at random"
    assert list(rows)[-1] == "MaskablePPO"
    assert len(rows) == len(example.MASKS) + 2
    table = capsys.readouterr().out
    for name, row in rows.items():
        assert f"| {name} |" in table
        assert row["nfe"] <= 6  # a first sample and two inpaintings of two steps
        assert np.isclose(row["used"].sum(), 1.0)
        assert row["best"] >= row["last"]
