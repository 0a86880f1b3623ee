"""The page of the viewer and the command: what is embedded, and what a browser makes of it."""

from __future__ import annotations

import base64
import html
import json
import re

import numpy as np
import pytest
import torch

from agents.cli import main
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.render import Pinhole, write_viewer
from scene_envs.render.stage import get_stage
from scene_envs.rotations import matrix_to_quaternion, yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

DIMSUM = get_scene_type("dimsum_table")


def scenes(count=3):
    """Scene k holds the table, a teapot on its left, k cups in a row and one tilted plate; slots 1 and 2 are empty."""
    batch = SceneBatch.empty(DIMSUM, count, slots=10)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    rotations = torch.eye(3).repeat(count, 10, 1, 1)
    for k in range(count):
        objects = [("teapot", (0.1, -0.35, 0.0)), ("dinner_plate", (0.0, 0.3, 0.2))]
        objects += [("teacup", (-0.3 + 0.2 * i, 0.0, 0.0)) for i in range(k)]
        for slot, (name, place) in enumerate(objects, start=3):
            translations[k, slot], categories[k, slot] = torch.tensor(place), DIMSUM.assets.index(name)
        rotations[k, 3] = yaw_matrix(torch.tensor(0.7))
        rotations[k, 4] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.8, 0.6]])
    return SceneBatch.from_parts(translations, rotations, categories, DIMSUM)


def embedded(path):
    return json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(), re.DOTALL)[1])


def array(text, dtype, columns=None):
    values = np.frombuffer(base64.b64decode(text), dtype)
    return values if columns is None else values.reshape(-1, columns)


# -- the file ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_one_file_that_asks_for_nothing_else(tmp_path):
    path = write_viewer(scenes(), tmp_path / "new" / "viewer.html")
    page = path.read_text()
    assert path.parent.joinpath("viewer.html").exists()
    assert [p.name for p in path.parent.iterdir()] == ["viewer.html"]
    assert "@@" not in page
    assert not re.search(r"https?://", page)
    assert not re.search(r"<script[^>]*\ssrc|<link[^>]*href=\"(?!data:)|\bimport\s*\(|\bfetch\s*\(|@import", page)
    assert path.stat().st_size < 1_000_000


@pytest.mark.slow
def test_poses_and_meshes_are_embedded_as_they_are(tmp_path):
    batch = scenes()
    data = embedded(write_viewer(batch, tmp_path / "viewer.html"))
    names = [asset["name"] for asset in data["assets"]]
    assert sorted(names) == ["cafe_table", "dinner_plate", "teacup", "teapot"]
    for k, scene in enumerate(data["scenes"]):
        slots = array(scene["slots"], "<u2").astype(int)
        assert slots.tolist() == torch.nonzero(~batch.is_empty[k]).flatten().tolist()
        assert [names[i] for i in array(scene["assets"], "<u2")] == batch.names()[k]
        poses = array(scene["poses"], "<f4", 7)
        np.testing.assert_array_equal(poses[:, :3], batch.translations[k, slots].numpy())
        np.testing.assert_allclose(poses[:, 3:], matrix_to_quaternion(batch.rotations[k, slots]).numpy(), atol=1e-6)
    for asset in data["assets"]:
        mesh, real = asset["visual"], DIMSUM.library[asset["name"]].visual
        steps = array(mesh["position"], "<u2", 3)
        vertices = np.array(mesh["low"]) + np.array(mesh["size"]) * steps / 65535
        np.testing.assert_allclose(vertices, real.vertices, atol=1e-5)
        np.testing.assert_array_equal(array(mesh["index"], "<u2", 3), real.faces)
        np.testing.assert_array_equal(array(mesh["color"], "u1", 3), np.asarray(real.visual.vertex_colors)[:, :3])
        parts = DIMSUM.library[asset["name"]].fine
        assert asset["fine"]["faces"] == [len(part.faces) for part in parts]
        assert asset["welded"] == (asset["name"] == "cafe_table")


@pytest.mark.slow
def test_more_scenes_cost_poses_only(tmp_path):
    one, many = (write_viewer(scenes(3)[[2] * n], tmp_path / f"{n}.html").stat().st_size for n in (1, 101))
    assert (many - one) / 100 < 500  # bytes; 5 objects of 32 bytes each, in base64, and a caption


@pytest.mark.slow
def test_titles_and_captions_cannot_break_the_page(tmp_path):
    nasty = "</script><script>alert(1)</script> & @@DATA@@ \u2028"
    path = write_viewer(scenes(1), tmp_path / "viewer.html", captions=[nasty], title=nasty)
    assert embedded(path)["scenes"][0]["caption"] == nasty
    assert path.read_text().count("</script>") == 2
    assert html.escape(nasty) in path.read_text()


@pytest.mark.slow
def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(InvalidInputError, match="at least one scene"):
        write_viewer(SceneBatch.empty(DIMSUM, 0), tmp_path / "viewer.html")
    with pytest.raises(InvalidInputError, match="3 scenes need 3 captions, got 1"):
        write_viewer(scenes(3), tmp_path / "viewer.html", captions=["a"])
    assert not list(tmp_path.iterdir())


# -- in a browser --------------------------------------------------------------------------------------------------

_SEEN = """(() => {
  const [width, height] = sceneViewer.size();
  const sums = {};
  sceneViewer.slots().forEach((slot, k) => {
    const sum = (sums[slot] = sums[slot] || [0, 0, 0]);
    sum[0] += 1; sum[1] += k % width; sum[2] += height - 1 - Math.floor(k / width);
  });
  return { width, height, sums };
})()"""
"""Per slot that is seen: pixels, sum of their columns, sum of their rows."""
_NO_WEBGL = """
const context = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : context.call(this, kind, ...rest);
};"""
"""What a page is answered where a browser has no WebGL."""


@pytest.mark.slow
def test_a_browser_draws_the_objects_where_they_are(browser, tmp_path):
    """Against the pinhole camera, and pixel by pixel against the software renderer."""
    batch = scenes()
    page = write_viewer(batch, tmp_path / "viewer.html", title="Three <scenes>")
    shown = browser.open(page, "#scene=2&azimuth=-40&elevation=50&distance=3.5&target=0.1,0,0&select=4")
    assert (shown["scenes"], shown["scene"], shown["selected"], shown["errors"]) == ("3", "2", "4", "0")
    assert shown["drawn"] == shown["objects"] == "5"  # the table, the teapot, the plate and two cups
    assert browser.run("document.title") == "Three <scenes>"
    assert browser.exceptions == []

    seen = browser.run(_SEEN)
    width, height = seen["width"], seen["height"]
    a, e = np.radians([-40.0, 50.0])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    target = np.array([0.1, 0.0, 0.0])
    camera = Pinhole.at(tuple(target + 3.5 * toward), tuple(target), (0.0, 0.0, 1.0), 28.0, width, height)
    stage = get_stage(DIMSUM.assets)
    poses = (part[2].double().numpy() for part in (batch.translations, batch.rotations))
    stage.place(*poses, batch.categories[2].numpy())
    slots = stage.look(camera).slots
    for slot in (-1, 0, 3, 4, 5, 6):
        pixels, x, y = seen["sums"][str(slot)]
        rows, columns = np.nonzero(slots == slot)
        assert pixels == pytest.approx(len(rows), rel=0.04, abs=12)
        np.testing.assert_allclose([y / pixels, x / pixels], [rows.mean(), columns.mean()], atol=1.0)
    right, focal = np.array([-np.sin(a), np.cos(a), 0.0]), 0.5 * height / np.tan(np.radians(14.0))
    point = np.array([0.0, 0.3, 0.2]) + np.array([0.0, -0.8, 0.6]) * 0.011 - target  # the middle of the tilted plate
    depth, up = 3.5 - point @ toward, np.cross(toward, right)
    expected = [width / 2 + focal * (point @ right) / depth, height / 2 - focal * (point @ up) / depth]
    pixels, x, y = seen["sums"]["4"]
    np.testing.assert_allclose([x / pixels + 0.5, y / pixels + 0.5], expected, atol=2.5)


@pytest.mark.slow
def test_the_screen_shows_a_shaded_picture_and_the_whole_table(browser, tmp_path):
    from PIL import Image

    browser.open(write_viewer(scenes(1), tmp_path / "viewer.html"))
    assert browser.run("document.getElementById('scenes').hidden") is True  # one scene needs no strip
    screen = np.asarray(Image.open(browser.screenshot(tmp_path / "screen.png")).convert("RGB")).astype(int)
    width, height = browser.run("[canvas.clientWidth, canvas.clientHeight]")
    picture = screen[:height, :width]
    assert len(np.unique(picture @ [1 << 16, 1 << 8, 1])) > 1000
    seen = browser.run(_SEEN)
    assert set(seen["sums"]) == {"-1", "0", "3", "4"}
    assert 0.15 < seen["sums"]["0"][0] / (seen["width"] * seen["height"]) < 0.6
    slots = np.array(browser.run("Array.from(sceneViewer.slots())")).reshape(seen["height"], seen["width"])[::-1]
    _, columns = np.nonzero(slots == 0)
    assert 0.01 * seen["width"] < columns.min() < columns.max() < 0.99 * seen["width"]
    wood = picture[slots == 0].mean(axis=0)
    assert wood[0] > wood[1] > wood[2]  # brown


@pytest.mark.slow
def test_keys_and_the_list_change_what_is_drawn(coarse_browser, tmp_path):
    browser = coarse_browser
    browser.open(write_viewer(scenes(3), tmp_path / "viewer.html"))
    visited = []
    for key in ("ArrowRight", "ArrowRight", "ArrowRight", "ArrowLeft", "Home", "End"):
        browser.press(key)
        visited.append(int(browser.shown()["scene"]))
    assert visited == [1, 2, 2, 1, 0, 2]
    browser.press("b")
    assert browser.shown()["background"] == "dark"
    before = browser.run(_SEEN)["sums"]
    browser.press("p")
    browser.press("c")
    assert browser.run("[sceneViewer.state.shape, sceneViewer.state.colors]") == ["fine", "classes"]
    after = browser.run(_SEEN)["sums"]
    for slot in before:  # the convex parts fill nearly the same pixels
        assert after[slot][0] == pytest.approx(before[slot][0], rel=0.1, abs=20)
    browser.run("document.querySelectorAll('#legend li')[0].click()")  # the cups
    shown = browser.shown()
    assert (shown["objects"], shown["drawn"], shown["errors"]) == ("5", "3", "0")
    rows = browser.run("Array.from(document.querySelectorAll('#legend li'), (row) => row.textContent)")
    assert rows == ["cup2", "plate1", "table1", "teapot1"]
    browser.run("document.querySelectorAll('#strip canvas')[1].click()")
    assert browser.shown()["scene"] == "1"
    browser.wait_for("location.hash.includes('scene=1')")


@pytest.mark.slow
def test_mouse_and_touch_move_the_camera_and_choose_objects(coarse_browser, tmp_path):
    browser = coarse_browser
    browser.open(write_viewer(scenes(1), tmp_path / "viewer.html"), "#azimuth=0&elevation=60&distance=3&target=0,0,0")
    left, top = 120.0, 150.0
    browser.drag((left, top), (left + 50, top))
    browser.drag((left, top), (left, top + 25))
    camera = browser.run("sceneViewer.camera()")
    assert (camera["azimuth"], camera["elevation"]) == pytest.approx((-20.0, 70.0))
    browser.mouse("Wheel", left, top, deltaX=0, deltaY=-100)
    nearer = browser.run("sceneViewer.camera()")
    assert nearer["distance"] < 0.95 * camera["distance"]
    browser.touch((100, 150), (200, 150), kind="Start")
    browser.touch((50, 150), (250, 150))
    browser.touch(kind="End")
    assert browser.run("sceneViewer.camera()")["distance"] == pytest.approx(0.5 * nearer["distance"], rel=0.02)
    browser.press("r")
    assert browser.run("sceneViewer.camera()")["elevation"] == pytest.approx(37.0)

    seen = browser.run(_SEEN)
    pixels, x, y = seen["sums"]["3"]  # the teapot
    ratio = browser.run("window.devicePixelRatio")
    place = (x / pixels / ratio, y / pixels / ratio)
    browser.drag(place, place)
    assert browser.shown()["selected"] == "3"
    facts = browser.run("document.getElementById('object-facts').textContent")
    assert "0.1000, -0.3500, 0.0000 m" in facts
    assert "0.0, 0.0, 40.1°" in facts  # a yaw of 0.7 rad
    browser.mouse("Moved", *place)
    browser.wait_for("document.getElementById('tooltip').textContent === 'teapot'")
    before = np.array(browser.run("sceneViewer.camera().target"))
    browser.drag((left, top), (left + 30, top), button="right")
    moved = np.array(browser.run("sceneViewer.camera().target")) - before
    assert abs(moved[2]) < 1e-9  # sideways only
    assert np.linalg.norm(moved) > 0.01
    browser.press("Escape")
    shown = browser.shown()
    assert (shown["selected"], shown["errors"]) == ("", "0")


@pytest.mark.slow
def test_without_webgl_the_scene_is_listed(coarse_browser, tmp_path):
    browser = coarse_browser
    browser.send("Page.enable")
    script = browser.send("Page.addScriptToEvaluateOnNewDocument", source=_NO_WEBGL)
    try:
        shown = browser.open(write_viewer(scenes(2), tmp_path / "viewer.html"))
        assert (shown["state"], shown["errors"]) == ("text", "0")
        browser.press("ArrowRight")
        assert browser.shown()["scene"] == "1"
        cells = browser.run("Array.from(document.querySelectorAll('td'), (cell) => cell.textContent)")
    finally:
        browser.send("Page.removeScriptToEvaluateOnNewDocument", **script)
        browser.send("Page.disable")
    assert len(cells) == 4 * 4
    assert cells[:3] == ["table", "0", "0.0000, 0.0000, 0.0000"]
    assert cells[4:8] == ["teapot", "3", "0.1000, -0.3500, 0.0000", "0.0, 0.0, 40.1"]
    assert cells[8:12] == ["plate", "4", "0.0000, 0.3000, 0.2000", "53.1, 0.0, 0.0"]


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
