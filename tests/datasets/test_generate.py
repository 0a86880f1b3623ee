"""Generation: what was asked for, verified by physics, and clear about what it refuses."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest
import torch

from scene_envs.datasets import SceneDataset, generate, generation, judge_scenes
from scene_envs.datasets.generation import generation_progress
from scene_envs.errors import InvalidInputError, PhysicsError, UnknownNameError
from scene_envs.grammars import register_grammar
from tests.helpers.toy_grammars import CUPS_COUNT, ToyGrammar, generate_cups, toy_cups


def test_shards_hold_the_scenes_that_were_asked_for(cups: Path) -> None:
    dataset = SceneDataset.load(cups)
    assert len(dataset) == CUPS_COUNT
    assert dataset.complete
    sizes = [len(SceneDataset.load(path)) for path in sorted(cups.glob("*.parquet"))]
    assert sizes == [15, 15, 10]
    assert [path.name for path in cups.iterdir() if path.name.startswith(".")] == []


def test_scenes_are_distinct(cups: Path) -> None:
    tensor = SceneDataset.load(cups).tensor
    assert len(torch.unique(tensor.flatten(1), dim=0)) == CUPS_COUNT


def test_every_scene_has_three_prompts(cups: Path) -> None:
    dataset = SceneDataset.load(cups)
    assert all(len(prompts) == 3 for prompts in dataset.prompt_sets)
    assert dataset.prompts == [prompts[0] for prompts in dataset.prompt_sets]


@pytest.mark.slow
def test_kept_scenes_pass_physics_and_thrown_ones_are_accounted_for(cups: Path, tmp_path: Path) -> None:
    """The toy grammar puts two cups in one place in 3/16 of its scenes."""
    dataset = SceneDataset.load(cups)
    assert judge_scenes(dataset.batch()) == [""] * CUPS_COUNT
    report = generate_cups(tmp_path)
    assert report.tried == CUPS_COUNT + report.reasons["penetration"]
    assert 2 <= report.reasons["penetration"] <= 25
    assert report.reasons["toy reason"] > 10


def test_an_unknown_backend_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="processes, ray"):
        generate_cups(tmp_path, backend="rai")


def test_a_grammar_of_a_notebook_is_refused_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import __main__

    monkeypatch.setattr(toy_cups, "__module__", "__main__")
    monkeypatch.setattr(__main__, "toy_cups", toy_cups, raising=False)
    monkeypatch.delattr(__main__, "__file__", raising=False)
    with pytest.raises(InvalidInputError, match=r"notebook.*workers=0"):
        generate_cups(tmp_path, count=1, workers=1)


def test_another_seed_gives_other_scenes(cups: Path, tmp_path: Path) -> None:
    generate_cups(tmp_path, count=5, seed=4)
    assert not torch.equal(SceneDataset.load(tmp_path).tensor, SceneDataset.load(cups).tensor[:5])


def test_a_folder_made_with_other_settings_is_refused(cups: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"'seed': 3.*'seed': 9"):
        generate_cups(cups, seed=9)


@pytest.mark.parametrize("bad", [{"count": 0}, {"shard_size": 0}, {"workers": -1}, {"seed": -1}])
def test_bad_arguments_are_named(bad: dict[str, int], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(bad))):
        generate_cups(tmp_path, **bad)


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInputError, match="not a folder"):
        generate_cups(tmp_path / "file")


def test_an_unknown_grammar_offers_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="dimsum_table"):
        generate("dim_sum_table", 1, tmp_path)


def test_a_grammar_that_workers_cannot_import_is_refused_with_the_remedy(tmp_path: Path) -> None:
    @register_grammar("local")
    def local() -> ToyGrammar:
        return toy_cups()

    with pytest.raises(InvalidInputError, match="workers=0"):
        generate("local", 2, tmp_path, workers=1, verify=False, progress=False)


def test_a_grammar_of_which_nothing_passes_is_given_up_with_the_reasons(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "_MAX_FRUITLESS", 40)
    with pytest.raises(PhysicsError, match="outside workspace"):
        generate_cups(tmp_path, grammar="toy_hopeless")


def test_a_log_gets_lines_with_rate_and_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(generation, "_EVERY", 0.0)
    with generation_progress("Generating tea", 100, 1000, True) as report:
        report(10, 12, {"penetration": 2})
        report(5, 6, {"no room": 7})
    first, second = stream.getvalue().strip().splitlines()
    assert first.startswith("Generating tea: 110/1000, ")
    assert first.endswith("scenes/s, penetration 2")
    assert second.endswith("no room 7, penetration 2")
    assert "115/1000" in second
