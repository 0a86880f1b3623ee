"""Real scenes of a run: those that the grammar gives, whatever is shown meanwhile."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from agents.post_training.real_scenes import _AT_ONCE, real_scenes
from agents.priors.testing import tiny_prior
from scene_envs.files import trim_folder
from scene_envs.grammars import get_grammar
from scene_envs.grammars.grammar import Grammar
from scene_envs.scene import SceneBatch

COUNT = 3 * _AT_ONCE + 5


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path))
    return tmp_path / "real_scenes"


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of scenes that grammars drew, one for each call."""
    calls: list[int] = []
    draw = Grammar.sample_array

    def counted(self: Grammar, rng: np.random.Generator, count: int) -> np.ndarray:
        calls.append(count)
        return draw(self, rng, count)

    monkeypatch.setattr(Grammar, "sample_array", counted)
    return calls


def scenes(seed: int = 5, count: int = COUNT) -> SceneBatch:
    return real_scenes(tiny_prior(), "grammar", count, seed=seed)[0]


@pytest.mark.parametrize("style", ["lines", "none"])
def test_scenes_of_the_grammar_do_not_depend_on_what_is_shown(style: str) -> None:
    prior, count = tiny_prior(), _AT_ONCE + 3
    batch, prompts = real_scenes(prior, "grammar", count, seed=5, progress=style)
    drawn = get_grammar(prior.scene_type).sample(np.random.default_rng(5), count)
    assert prompts is None
    assert torch.equal(batch.tensor, drawn.with_slots(batch.tensor.shape[1]).tensor)


def test_a_later_run_takes_the_kept_scenes_bit_for_bit(cache: Path, drawn: list[int]) -> None:
    first = scenes()
    assert sum(drawn) == COUNT
    drawn.clear()
    again = scenes()
    assert drawn == [_AT_ONCE]  # those that are compared
    assert torch.equal(first.tensor, again.tensor)
    assert torch.equal(torch.signbit(first.tensor), torch.signbit(again.tensor))
    scenes(seed=6)
    scenes(count=COUNT - 1)
    assert len(list(cache.iterdir())) == 3  # another seed or number is another file


def test_few_scenes_are_not_kept(cache: Path) -> None:
    scenes(count=_AT_ONCE)
    assert not cache.exists()


def test_damaged_and_foreign_files_are_drawn_anew_and_said(
    cache: Path, drawn: list[int], caplog: pytest.LogCaptureFixture
) -> None:
    right = scenes()
    (path,) = cache.iterdir()
    scenes(seed=6)
    content, (other,) = path.read_bytes(), [file for file in cache.iterdir() if file != path]
    for wrong in (content[: len(content) // 2], content[:-1] + bytes([content[-1] ^ 1]), other.read_bytes()):
        path.write_bytes(wrong)
        drawn.clear()
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            assert torch.equal(scenes().tensor, right.tensor)
        assert sum(drawn) == COUNT
        assert "are not taken and drawn anew" in caplog.text
        assert path.read_bytes() == content  # written again


def test_a_cache_that_cannot_be_written_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path / "file"))
    with caplog.at_level(logging.WARNING):
        assert len(scenes()) == COUNT
    assert "could not be kept" in caplog.text


def test_files_that_were_used_longest_ago_go_first(tmp_path: Path) -> None:
    for age, name in enumerate("dcba"):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    trim_folder(tmp_path, 29)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c", "d"]
