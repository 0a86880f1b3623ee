"""The page of the viewer: what is embedded, and what a browser makes of it."""

from __future__ import annotations

import base64
import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch

from scene_envs.errors import InvalidInputError
from scene_envs.render import write_viewer
from scene_envs.render.stage import get_stage
from scene_envs.rotations import matrix_to_quaternion, yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, get_scene_type

DIMSUM = get_scene_type("dimsum_table")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


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


def test_one_file_that_asks_for_nothing_else(tmp_path):
    path = write_viewer(scenes(), tmp_path / "new" / "viewer.html")
    page = path.read_text()
    assert path.parent.joinpath("viewer.html").exists()
    assert [p.name for p in path.parent.iterdir()] == ["viewer.html"]
    assert "@@" not in page
    assert not re.search(r"https?://", page)
    assert not re.search(r"<script[^>]*\ssrc|<link[^>]*href=\"(?!data:)|\bimport\s*\(|\bfetch\s*\(|@import", page)
    assert path.stat().st_size < 1_000_000


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


def test_more_scenes_cost_poses_only(tmp_path):
    one, many = (write_viewer(scenes(3)[[2] * n], tmp_path / f"{n}.html").stat().st_size for n in (1, 101))
    assert (many - one) / 100 < 500  # bytes; 5 objects of 32 bytes each, in base64, and a caption


def test_titles_and_captions_cannot_break_the_page(tmp_path):
    nasty = "</script><script>alert(1)</script> & @@DATA@@ \u2028"
    path = write_viewer(scenes(1), tmp_path / "viewer.html", captions=[nasty], title=nasty)
    assert embedded(path)["scenes"][0]["caption"] == nasty
    assert path.read_text().count("</script>") == 2
    assert html.escape(nasty) in path.read_text()


def test_wrong_arguments_are_named(tmp_path):
    with pytest.raises(InvalidInputError, match="at least one scene"):
        write_viewer(SceneBatch.empty(DIMSUM, 0), tmp_path / "viewer.html")
    with pytest.raises(InvalidInputError, match="3 scenes need 3 captions, got 1"):
        write_viewer(scenes(3), tmp_path / "viewer.html", captions=["a"])
    assert not list(tmp_path.iterdir())


# -- in a browser --------------------------------------------------------------------------------------------------

_DRIVER = """
<script>
const wait = () => new Promise((done) => setTimeout(done, 20));
const press = (key) => document.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
const seen = () => {
  const [width, height] = sceneViewer.size();
  const sums = {};
  sceneViewer.slots().forEach((slot, k) => {
    const sum = (sums[slot] = sums[slot] || [0, 0, 0]);
    sum[0] += 1; sum[1] += k % width; sum[2] += height - 1 - Math.floor(k / width);
  });
  return { width, height, sums, camera: sceneViewer.camera() };
};
(async () => {
  while (document.body.dataset.state === "loading") await wait();
  const result = {};
  const note = async (name) => {
    await wait();
    if (document.body.dataset.state === "ready") sceneViewer.draw();
    result[name] = { ...document.body.dataset };
  };
  try { await (async () => { STEPS })(); } catch (problem) { result.problem = String(problem); }
  document.body.dataset.result = JSON.stringify(result);
})();
</script>
"""


def drive(page, steps, *, address="", flags=(), tmp_path):
    """Open ``page`` in a headless browser, run ``steps`` (JavaScript) there: the DOM, what they noted, the screen."""
    copy = tmp_path / "driven.html"
    copy.write_text(page.read_text().replace("</body>", _DRIVER.replace("STEPS", steps) + "</body>"))
    picture = tmp_path / "screen.png"
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader", "--hide-scrollbars", "--window-size=700,560", "--virtual-time-budget=20000",
        f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}", "--dump-dom", *flags,
        f"file://{copy}{address}",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    noted = re.search(r'data-result="(.*?)"', done.stdout)
    assert noted, (
        f"the page did not get through the steps: {re.findall('<body.*?>', done.stdout)}\n{done.stderr[-1500:]}"
    )
    result = json.loads(html.unescape(noted[1]))
    assert "problem" not in result, result["problem"]
    return done.stdout, result, picture


@needs_browser
def test_a_browser_draws_the_objects_where_they_are(tmp_path):
    """Against the pinhole camera, and pixel by pixel against the software renderer."""
    pytest.importorskip("pybullet")
    from PIL import Image

    batch = scenes()
    page = write_viewer(batch, tmp_path / "viewer.html", title="Three <scenes>")
    steps = """
      result.seen = seen();
      await note("start");
      press("ArrowLeft"); await note("left");
      press("ArrowLeft"); press("ArrowLeft"); await note("first");
      press("p"); press("c"); press("b"); await note("keys");
      sceneViewer.showScene(99); await note("last");
    """
    dom, result, picture = drive(
        page, steps, address="#scene=2&azimuth=-40&elevation=50&distance=3.5&target=0.1,0,0&select=4", tmp_path=tmp_path
    )
    assert 'data-errors="0"' in dom
    assert "<title>Three &lt;scenes&gt;</title>" in dom
    start = result["start"]
    assert (start["state"], start["scenes"], start["scene"], start["selected"]) == ("ready", "3", "2", "4")
    assert start["drawn"] == start["objects"] == "5"  # the table, the teapot, the plate and two cups
    assert [result[name]["scene"] for name in ("left", "first", "keys", "last")] == ["1", "0", "0", "2"]
    assert (result["first"]["drawn"], result["keys"]["background"]) == ("3", "dark")

    seen = result["seen"]
    width, height = seen["width"], seen["height"]
    a, e = np.radians([-40.0, 50.0])
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    camera = Camera(tuple(np.array([0.1, 0.0, 0.0]) + 3.5 * toward), (0.1, 0.0, 0.0), (0.0, 0.0, 1.0), fov_y=28.0)
    stage = get_stage(DIMSUM.assets)
    stage.place(
        batch.translations[2].double().numpy(),
        matrix_to_quaternion(torch.where(batch.is_empty[2, :, None, None], torch.eye(3), batch.rotations[2])).numpy(),
        batch.categories[2].numpy(),
    )
    slots = stage.look(camera, width, height).slots
    for slot in (-1, 0, 3, 4, 5, 6):
        pixels, x, y = seen["sums"][str(slot)]
        rows, columns = np.nonzero(slots == slot)
        assert pixels == pytest.approx(len(rows), rel=0.04, abs=12)
        np.testing.assert_allclose([y / pixels, x / pixels], [rows.mean(), columns.mean()], atol=1.0)
    right, focal = np.array([-np.sin(a), np.cos(a), 0.0]), 0.5 * height / np.tan(np.radians(14.0))
    point = np.array([0.0, 0.3, 0.2]) + np.array([0.0, -0.8, 0.6]) * 0.011 - np.array([0.1, 0.0, 0.0])
    depth = 3.5 - point @ toward
    expected = [
        width / 2 + focal * (point @ right) / depth,
        height / 2 - focal * (point @ np.cross(toward, right)) / depth,
    ]
    pixels, x, y = seen["sums"]["4"]
    np.testing.assert_allclose([x / pixels + 0.5, y / pixels + 0.5], expected, atol=2.5)

    screen = np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3)
    assert len(np.unique(screen, axis=0)) > 500


@needs_browser
def test_the_first_view_shows_the_whole_support_and_hidden_assets_are_left_out(tmp_path):
    page = write_viewer(scenes(1), tmp_path / "viewer.html")
    steps = """
      result.seen = seen();
      document.querySelectorAll("#legend li")[1].click(); await note("hidden");
      result.rows = Array.from(document.querySelectorAll("#legend li"), (row) => row.textContent);
    """
    _, result, _ = drive(page, steps, tmp_path=tmp_path)
    assert result["rows"] == ["plate1", "table1", "teapot1"]
    assert (result["hidden"]["objects"], result["hidden"]["drawn"]) == ("3", "2")
    width, height, sums = (result["seen"][name] for name in ("width", "height", "sums"))
    assert set(sums) == {"-1", "0", "3", "4"}
    assert 0.15 < sums["0"][0] / (width * height) < 0.6


@needs_browser
def test_without_webgl_the_scene_is_listed(tmp_path):
    page = write_viewer(scenes(2), tmp_path / "viewer.html")
    steps = "await note('start'); press('ArrowRight'); await note('next');"
    dom, result, _ = drive(page, steps, flags=["--disable-3d-apis"], tmp_path=tmp_path)
    assert result["start"]["state"] == "text"
    assert result["next"]["scene"] == "1"
    cells = [re.sub("<.*?>", "", cell) for cell in re.findall(r"<td>.*?</td>", dom)]
    assert cells[:3] == ["table", "0", "0.0000, 0.0000, 0.0000"]
    assert len(cells) == 4 * 4
    assert cells[4:8] == ["teapot", "3", "0.1000, -0.3500, 0.0000", "0.0, 0.0, 40.1"]
    assert cells[8:12] == ["plate", "4", "0.0000, 0.3000, 0.2000", "53.1, 0.0, 0.0"]
