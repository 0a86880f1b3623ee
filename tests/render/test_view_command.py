"""``scene-envs view`` on everything it reads."""

from __future__ import annotations

import json
import re

import pytest
import torch

from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch

BATCH = SceneBatch.empty("dimsum_table", 5, slots=4)


@pytest.fixture
def samples(tmp_path):
    """A run's folder with five scenes; scene k has its table k cm up."""
    translations = BATCH.translations.clone()
    translations[:, 0, 2] = torch.arange(5) * 0.01
    batch = BATCH.with_poses(translations, BATCH.rotations)
    batch.save(tmp_path / "run" / "scenes.safetensors")
    return tmp_path / "run"


def page(folder):
    text = (folder / "viewer.html").read_text()
    return re.search("<title>(.*?)</title>", text)[1], json.loads(
        re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1]
    )


def view(*words):
    return main(["view", "pictures=0", *map(str, words)])


def test_a_scene_file_and_the_folder_of_its_run(samples, tmp_path, capsys):
    assert view(f"scenes={samples / 'scenes.safetensors'}", f"output={tmp_path / 'a'}") == 0
    assert str(tmp_path / "a" / "viewer.html") in capsys.readouterr().out
    title, data = page(tmp_path / "a")
    assert (title, len(data["scenes"])) == ("run", 5)
    assert view(f"scenes={samples}", "first=2", "count=2", "title=Mine", f"output={tmp_path / 'b'}") == 0
    title, part = page(tmp_path / "b")
    assert title == "Mine"
    assert part["scenes"] == data["scenes"][2:4]
    assert json.loads((tmp_path / "b" / "metrics.json").read_text())["scenes"] == 2


def test_what_was_made_ready_is_shown_rather_than_what_it_was_made_of(samples, tmp_path):
    BATCH[:1].save(samples / "ready.safetensors")
    assert view(f"scenes={samples}", f"output={tmp_path / 'out'}") == 0
    assert len(page(tmp_path / "out")[1]["scenes"]) == 1


def test_a_dataset_with_its_prompts_as_captions(tmp_path):
    prompts = [f"A scene with {k} objects." for k in range(5)]
    dataset = SceneDataset(BATCH.tensor, prompts, Normalizer.fit(BATCH.tensor), BATCH.scene_type)
    dataset.save(tmp_path / "data")
    assert view(f"scenes={tmp_path / 'data'}", "first=1", "count=2", f"output={tmp_path / 'out'}") == 0
    title, data = page(tmp_path / "out")
    assert title == "data"
    assert [scene["caption"] for scene in data["scenes"]] == prompts[1:3]


@pytest.mark.slow
def test_a_prior_and_a_grammar(tmp_path):
    tiny_prior(slots=6).save(tmp_path / "prior")
    words = ("count=2", "num_steps=2")
    assert view(f"prior={tmp_path / 'prior'}", *words, f"output={tmp_path / 'a'}") == 0
    assert len(page(tmp_path / "a")[1]["scenes"]) == 2
    guided, scenes = tiny_prior(slots=6).with_physics_guidance(1.0).save(tmp_path / "guided"), {}
    for strength in ("null", "1", "0"):
        assert view(f"prior={guided}", *words, f"physics_guidance={strength}", f"output={tmp_path / strength}") == 0
        scenes[strength] = page(tmp_path / strength)[1]["scenes"]
    assert scenes["null"] == scenes["1"] != scenes["0"]
    for name, seed in (("b", 0), ("c", 0), ("d", 1)):
        assert view("scene=dimsum_table", "count=2", f"seed={seed}", f"output={tmp_path / name}") == 0
    first, again, other = (page(tmp_path / name)[1] for name in "bcd")
    assert first == again != other


@pytest.mark.slow
def test_pictures_are_drawn_beside_the_page(tmp_path):
    pytest.importorskip("pybullet")
    assert main(["view", "scene=dimsum_table", "count=2", "pictures=1", f"output={tmp_path / 'a'}"]) == 0
    assert (tmp_path / "a" / "gallery.png").stat().st_size > 1000


def test_the_browser_is_opened_when_asked(samples, tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or False)
    assert view(f"scenes={samples}", "open=true", f"output={tmp_path / 'a'}") == 0
    assert opened == [(tmp_path / "a" / "viewer.html").resolve().as_uri()]
    assert "no browser was found" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "say what to show"),
        (["scenes=RUN", "prior=dimsum_table"], "either scenes= or prior="),
        (["scene=dimsum_table", "prior=dimsum_table"], "either prior= or scene="),
        (["scenes=RUN", "first=5"], "first=5 is beyond the 5 scenes"),
        (["scenes=RUN", "count=0"], "count=0"),
        (["scene=dimsum_tabel"], "did you mean 'dimsum_table'"),
        (["prior=dimsum_tabel"], "dimsum_tabel"),
        (["scenes=RUN/none"], "RUN/none"),
        (["scenes=RUN/none.safetensors"], "no scene file"),
    ],
)
def test_wrong_input_exits_2_with_one_paragraph(words, message, samples, tmp_path, capsys):
    words = [word.replace("RUN", str(samples)) for word in words]
    assert view(*words, f"output={tmp_path / 'out'}") == 2
    error = capsys.readouterr().err
    assert message.replace("RUN", str(samples)) in error
    assert len(error.strip().splitlines()) == 1
    assert not (tmp_path / "out" / "viewer.html").exists()
