"""The commands render and view: what files hold agrees with what `observe` gives, and wrong settings are named."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from agents.cli import main
from scene_envs.grammars import get_grammar
from scene_envs.render import Pinhole, observe
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera

LOOK = {"position": [1.2, -0.8, 1.1], "target": [0.0, 0.0, 0.0], "up": [0, 0, 1], "width": 64, "height": 48}
POSE = {"pose": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 1.5], [0, 0, 0, 1]], "fx": 60.0, "fy": 62.0, "cx": 24.0,
        "cy": 21.5, "width": 50, "height": 40}  # fmt: skip


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    return batch.save(tmp_path_factory.mktemp("scenes") / "scenes.safetensors")


def png(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(np.int64)


def decoded(segmentation: dict[str, list[int]]) -> np.ndarray:
    """The mask of an uncompressed run-length code, by its definition: runs of 0 and 1 in turn, column by column."""
    height, width = segmentation["size"]
    values = np.arange(len(segmentation["counts"])) % 2
    return np.repeat(values, segmentation["counts"]).reshape(width, height).T.astype(bool)


def test_files_hold_what_cameras_of_both_kinds_see(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text(json.dumps([LOOK, POSE]))
    out = tmp_path / "out"
    words = [f"scenes={scenes}", "count=2", f"cameras={tmp_path / 'cameras.json'}", f"output={out}"]
    modes = ["rgb", "depth", "instance", "category", "normals", "semantic"]
    assert main(["render", *words, f"modes=[{','.join(modes)}]"]) == 0
    batch = SceneBatch.load(scenes)[:2]
    numbers = {key: value for key, value in POSE.items() if key != "pose"}
    cameras = [Camera(**LOOK), Pinhole(np.array(POSE["pose"]), **numbers)]
    written = [Pinhole(**entry) for entry in json.loads((out / "cameras.json").read_text())]
    np.testing.assert_array_equal(written[1].pose, cameras[1].pose)
    assert (written[1].fx, written[1].cy, written[0].width) == (60.0, 21.5, 64)
    views = observe(batch, cameras, [*modes, "boxes"])
    coco = json.loads((out / "annotations.json").read_text())
    assert [image["file_name"] for image in coco["images"]] == [f"rgb/00000{s}_{c}.png" for s in (0, 1) for c in (0, 1)]
    assert [category["name"] for category in coco["categories"]] == list(batch.scene_type.assets)
    for image in coco["images"]:
        scene, view = image["scene"], views[image["camera"]]
        read = {mode: png(out / image["file_name"].replace("rgb", mode)) for mode in modes}
        height, width = view["depth"].shape[1:]
        assert (image["height"], image["width"]) == (height, width)
        for mode in ("rgb", "semantic"):
            np.testing.assert_array_equal(read[mode], view[mode][scene])
        seen = np.isfinite(view["depth"][scene])
        np.testing.assert_allclose(read["depth"][seen], 1000.0 * view["depth"][scene][seen], atol=0.51)
        assert (read["depth"][~seen] == 0).all()
        np.testing.assert_array_equal(read["instance"] - 1, view["instance"][scene])
        np.testing.assert_array_equal(
            np.where(seen, read["category"] - 1, batch.scene_type.num_assets), view["category"][scene]
        )
        np.testing.assert_allclose(read["normals"] / 127.5 - 1.0, view["normals"][scene], atol=0.005)
        marked = [annotation for annotation in coco["annotations"] if annotation["image_id"] == image["id"]]
        assert {entry["slot"] for entry in marked} == set(np.unique(view["instance"][scene]).tolist()) - {-1}
        for entry in marked:
            mask = decoded(entry["segmentation"])
            np.testing.assert_array_equal(mask, view["instance"][scene] == entry["slot"])
            assert entry["area"] == mask.sum()
            assert entry["category_id"] == int(batch.categories[scene, entry["slot"]]) + 1
            left, top, across, down = entry["bbox"]
            assert [left, top, left + across, top + down] == view["boxes"][scene][entry["slot"]].tolist()
    assert [entry["id"] for entry in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))


def test_depth_as_numbers_and_the_camera_of_the_scene_type(scenes: Path, tmp_path: Path) -> None:
    assert (
        main(["render", f"scenes={scenes}", "count=1", "modes=[depth]", "depth=npy", f"output={tmp_path / 'out'}"]) == 0
    )
    depth = np.load(tmp_path / "out" / "depth" / "000000_0.npy")
    np.testing.assert_array_equal(depth, observe(SceneBatch.load(scenes)[:1], modes=["depth"])[0]["depth"][0])
    content = json.loads((tmp_path / "out" / "annotations.json").read_text())
    assert content["images"][0]["file_name"] == "depth/000000_0.npy"
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["images"] == 1


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('[{"pose": [[1, 0], [0, 1]], "fx": 1, "fy": 1, "cx": 0, "cy": 0, "width": 4, "height": 4}]', "rigid motion"),
        (json.dumps([POSE | {"fx": 0}]), "a camera's fx=0 must be a positive number"),
        (json.dumps([LOOK | {"target": LOOK["position"]}]), "cannot look at"),
        ('[{"position": [0, 0, 1], "zoom": 3}]', "unexpected keyword argument 'zoom'"),
        ("{", "no JSON list of cameras"),
        (json.dumps([LOOK | {"position": [0, 0, -0.02], "target": [0, 0, 1], "up": [1, 0, 0]}]),
         "camera 0 at .0.0, 0.0, -0.02. is inside the 'cafe_table' in slot 0 of scene 0"),
    ],
)  # fmt: skip
def test_impossible_cameras_are_named(
    entry: str, message: str, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cameras.json").write_text(entry)
    words = [f"scenes={scenes}", "count=1", "modes=[depth]", f"cameras={tmp_path / 'cameras.json'}"]
    assert main(["render", *words, f"output={tmp_path / 'out'}"]) == 2
    assert message.replace(".0.0, 0.0, -0.02.", "[0.0, 0.0, -0.02]") in capsys.readouterr().err


def test_view_refuses_a_scene_type_that_its_scenes_are_not_of(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", f"scenes={scenes}", "scene=pantry_shelf", f"output={tmp_path / 'out'}"]) == 2
    assert "are of type 'dimsum_table', not scene=pantry_shelf; leave scene= out" in capsys.readouterr().err
