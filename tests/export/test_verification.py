"""The certificate of an export: what judges find in the files, and what the commands make of it."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.export import export, place, verification, verify
from scene_envs.physics import penetration
from scene_envs.scene import SceneBatch
from tests.helpers.export_scenes import jittered_scene, laid_scene, make

FORMATS = ["npz", "mjcf", "urdf"]
FALL = 0.5 * 9.81 * 0.1**2 * 1e3
"""Way of free fall in 0.1 s, mm."""


@pytest.fixture(autouse=True)
def _a_fifth_of_a_second(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Judges simulate 0.2 s and not 2 s, but where a table is laid."""
    if "laid_table" not in request.node.name:
        monkeypatch.setattr(verification, "_LATE", 0.2)


def plate(height: float = 0.0) -> SceneBatch:
    """A plate on the table, or above it (m)."""
    return make(np.array([[0.2, 0.1, height]]), np.eye(3)[None], ["dinner_plate"], 3)


def findings(report, name: str) -> list:
    return [found for found in report.findings if found.judge == name]


def test_a_laid_table_is_ready_for_all_judges(tmp_path):
    pytest.importorskip("pybullet")
    export(laid_scene(), tmp_path, FORMATS)
    report = verify(tmp_path)
    assert {"bullet engine", "mujoco engine", "MuJoCo, MJCF", "PyBullet, URDF"} <= set(report.versions)
    assert report.ready == (True,)
    assert all(found.largest["motion in 0.1 s, mm"] < 0.1 for found in report.findings)
    assert report.missing["Drake, SDF"] == "no world.sdf in the export"
    written = json.loads((tmp_path / "verify.json").read_text())
    assert written["ready"] is True
    assert written["digest"] == json.loads((tmp_path / "export.json").read_text())["digest"]
    assert "1 of 1 scenes are ready" in (tmp_path / "verify.txt").read_text()


def test_all_judges_measure_a_free_fall(tmp_path, capsys):
    pytest.importorskip("pybullet")
    export(SceneBatch.concatenate([plate(), plate(0.5)]), tmp_path, FORMATS)
    assert main(["verify", str(tmp_path)]) == 1
    printed = capsys.readouterr()
    assert "1 of 2 scenes are not ready" in printed.err
    for judge in ("bullet engine", "mujoco engine", "MuJoCo, MJCF", "PyBullet, URDF"):
        line = re.search(rf"scene_001, {judge}: dinner_plate_0: motion in 0.1 s, mm ([\d.]+)", printed.out)
        assert float(line[1]) == pytest.approx(FALL, rel=0.05), judge  # a step of 1/240 s adds 4 %
    assert "scene_000," not in printed.out


def test_each_judge_reads_its_own_file(tmp_path):
    export(plate(), tmp_path, ["npz", "mjcf"])
    path = tmp_path / "scene_000" / "scene.xml"
    text = path.read_text()
    path.write_text(re.sub(r'(name="dinner_plate_0" pos="\S+ \S+ )\S+"', r'\g<1>0.3"', text))
    report = verify(tmp_path)
    assert findings(report, "mujoco engine")[0].faults == []
    assert findings(report, "MuJoCo, MJCF")[0].largest["motion in 0.1 s, mm"] == pytest.approx(FALL, rel=0.05)
    assert report.ready == (False,)
    path.write_text("<mujoco>")
    report = verify(tmp_path)
    assert "not simulated" in findings(report, "MuJoCo, MJCF")[0].faults[0]
    assert json.loads((tmp_path / "verify.json").read_text())["ready_scenes"] == [False]


def test_overlaps_are_those_of_the_exact_depths(tmp_path):
    batch = jittered_scene(3)
    export(batch, tmp_path, "mjcf")
    found = verification._mujoco(tmp_path / "scene_000" / "scene.xml")
    depth = 1e3 * penetration(batch).depth[0]
    for thing in place(batch)[0].objects:
        assert found[thing.name][0] == pytest.approx(float(depth[thing.slot]), abs=0.01), thing.name


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "judge", "form"),
    [("pydrake", "Drake, SDF", "sdf"), ("newton", "Newton, MJCF", "mjcf")],
)
def test_other_simulators_judge_their_files(module, judge, form, tmp_path):
    pytest.importorskip(module)
    export(SceneBatch.concatenate([plate(), plate(0.5)]), tmp_path, form)
    report = verify(tmp_path)
    assert report.ready == (True, False)
    rest, fall = findings(report, judge)
    assert max(rest.largest.values()) < 0.1
    assert fall.largest["motion in 0.1 s, mm"] == pytest.approx(FALL, rel=0.05)


def test_drake_judges_its_directives(tmp_path):
    pytest.importorskip("pydrake")
    export(plate(0.5), tmp_path, "drake")
    [fall] = findings(verify(tmp_path), "Drake, directives")
    assert fall.largest["motion in 0.1 s, mm"] == pytest.approx(FALL, rel=0.05)


def test_simulators_that_are_missing_are_named_with_the_line_that_installs_them(tmp_path, monkeypatch):
    find = verification.find_spec
    monkeypatch.setattr(verification, "find_spec", lambda name: None if name in ("newton", "pybullet") else find(name))
    export(plate(), tmp_path, FORMATS)
    assert main(["verify", str(tmp_path)]) == 0
    text = (tmp_path / "verify.txt").read_text()
    assert 'Newton, MJCF, not installed: pip install "newton[sim,importers]"' in text
    assert "PyBullet, URDF, not installed: pip install pybullet" in text


def test_engines_do_not_judge_files_of_another_friction(tmp_path):
    export(plate(), tmp_path, ["npz", "mjcf"], friction=0.3)
    report = verify(tmp_path)
    assert "other friction" in report.missing["mujoco engine"]
    assert "MuJoCo, MJCF" in report.versions


def test_wrong_input_is_named(tmp_path, capsys):
    assert main(["verify", str(tmp_path)]) == 2
    assert "holds no export.json" in capsys.readouterr().err
    export(plate(), tmp_path, "glb")
    with pytest.raises(InvalidInputError, match="or no file that can be judged"):
        verify(tmp_path)
    (tmp_path / "export.json").write_text("{}")
    assert main(["verify", str(tmp_path)]) == 2
    assert main(["sample", "verify=true"]) == 2
    assert "add project=true and export=" in capsys.readouterr().err


def test_sample_exports_only_what_all_judges_find_ready(tmp_path, monkeypatch, capsys):
    judged = verification.JUDGES["mujoco engine"]

    def second_falls(path):
        return {name: [0.0, 0.0, 0.0, 7.0 * ("scene_001" in str(path))] for name in judged[3](path)}

    monkeypatch.setattr(verification, "JUDGES", {"mujoco engine": (*judged[:3], second_falls)})
    prior = tiny_prior(slots=4).save(tmp_path / "prior")
    words = ["count=3", "num_steps=2", "reward=null", "pictures=0", "workers=0", "project=true", "export=mjcf"]
    assert main(["sample", f"prior={prior}", *words, "verify=true", f"output={tmp_path / 'out'}"]) == 0
    out = tmp_path / "out"
    assert json.loads((out / "metrics.json").read_text())["export"]["scenes"] == 2
    assert {path.name for path in (out / "export").glob("scene_*")} == {"scene_000", "scene_001"}
    assert json.loads((out / "verify.json").read_text())["ready_scenes"] == [True, False, True]
    assert not (out / "export" / "scene_000" / "scene.npz").exists()
    assert "2 of 3 scenes are ready for all judges; 1 dropped" in capsys.readouterr().out
    monkeypatch.setattr(verification, "LIMITS", dict.fromkeys(verification.LIMITS, -1.0))  # nothing is within them
    words[-1] = "export=worlds"
    assert main(["sample", f"prior={prior}", *words, "verify=true", f"output={tmp_path / 'none'}"]) == 0
    assert "export" not in json.loads((tmp_path / "none" / "metrics.json").read_text())
    assert "0 of 3 scenes are ready for all judges; 3 dropped" in capsys.readouterr().out


def test_a_former_file_of_a_scene_and_a_lost_version_end_no_verdict(tmp_path, monkeypatch):
    export(plate(), tmp_path, ["npz", "mjcf"])
    file, module, _, judged = verification.JUDGES["MuJoCo, MJCF"]
    monkeypatch.setitem(verification.JUDGES, "MuJoCo, MJCF", (file, module, "no-such-package", judged))
    (tmp_path / "scene_000.xml").write_text("an export of before")
    report = verify(tmp_path)
    assert report.versions["MuJoCo, MJCF"] == "unknown"
    assert report.ready == (True,)


def test_sample_has_a_judge_for_each_format(tmp_path, capsys):
    (tmp_path / "mass.yaml").write_text("mass: {uniform: [0.9, 1.1]}")
    prior = tiny_prior(slots=4).save(tmp_path / "prior")
    words = ["count=1", "num_steps=2", "reward=null", "pictures=0", "workers=0", "project=true", "export=worlds"]
    words += ["verify=true", f"randomization={tmp_path / 'mass.yaml'}", f"output={tmp_path / 'out'}"]
    for _ in range(2):  # the same command again writes the same
        assert main(["sample", f"prior={prior}", *words]) == 0
    assert "MuJoCo, MJCF" in capsys.readouterr().out
