"""``scene-envs render``."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from agents.cli.run_folder import Run
from scene_envs.errors import Checked, Count, InvalidInputError, OneOf

_MODES = ("rgb", "depth", "instance", "category", "normals", "semantic")


@dataclass
class RenderConfig(Checked):
    """Images of cameras in scenes, with annotations as those of COCO.

    Attributes:
        scenes: a scene file, a folder of scene files, the folder of a run that holds scenes, or a dataset.
        count: number of scenes, from the first; null for all.
        modes: images to write, of rgb, depth, instance, category, normals, semantic.
        cameras: a JSON file with a list of cameras, by position, target and up, or by pose and intrinsics; the camera
            of the scene type if it is empty.
        depth: file of depth images: png of 16 bits in mm, or npy of float32 in m.
        output: folder for MODE/SCENE_CAMERA.png, annotations.json and cameras.json.
    """

    scenes: str = ""
    count: Count | None = 16
    modes: list[str] = field(default_factory=lambda: list(_MODES[:-1]))
    cameras: str = ""
    depth: Annotated[str, OneOf(("png", "npy"))] = "png"
    output: str = ""


def check(settings: RenderConfig) -> None:
    """Refuse settings that name no scenes or no images."""
    if not settings.scenes:
        raise InvalidInputError("render: name a scene file, run or dataset, as in scenes=runs/mine")
    if not settings.modes or not {*settings.modes} <= {*_MODES}:
        raise InvalidInputError(f"modes={settings.modes}: give some of {', '.join(_MODES)}")


def run(settings: RenderConfig, run: Run) -> None:
    """Draw scene by scene; write the images, their cameras and the annotations of what is seen."""
    import numpy as np
    from PIL import Image

    from scene_envs.datasets import load_scenes
    from scene_envs.files import write_json
    from scene_envs.render.pictures import observe_each
    from scene_envs.render.stage import to_pinhole

    batch = load_scenes(Path(settings.scenes), settings.count)
    assets = batch.scene_type.assets
    pinholes = [to_pinhole(camera) for camera in _cameras(settings.cameras) or [batch.scene_type.camera]]
    write_json(run.directory / "cameras.json", [{**vars(camera), "pose": camera.pose.tolist()} for camera in pinholes])
    files = {mode: f"{mode}/{{:06d}}_{{}}.{settings.depth if mode == 'depth' else 'png'}" for mode in settings.modes}
    for mode in files:
        (run.directory / mode).mkdir(exist_ok=True)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    modes: list[Any] = [*files, "instance", "boxes"]
    for scene, views in enumerate(observe_each(batch, pinholes, modes)):
        categories = batch.categories[scene].tolist()
        for index, view in enumerate(views):
            seen = {str(mode): image for mode, image in view.items()}
            for mode, file in files.items():
                path = run.directory / file.format(scene, index)
                if path.suffix == ".npy":
                    np.save(path, seen[mode])
                else:
                    Image.fromarray(_pixels(mode, seen[mode], len(assets))).save(path)
            height, width = seen["instance"].shape
            name = {"id": len(images) + 1, "file_name": files[settings.modes[0]].format(scene, index)}
            images.append({**name, "width": width, "height": height, "scene": scene, "camera": index})
            for slot, (left, top, right, bottom) in enumerate(seen["boxes"].tolist()):
                if right > left:
                    mask = (seen["instance"] == slot).T.ravel()  # column by column
                    runs = np.diff(np.flatnonzero(np.diff(mask, prepend=False)), prepend=0, append=mask.size)
                    owner = {"image_id": len(images), "category_id": categories[slot] + 1, "slot": slot, "iscrowd": 0}
                    place = {"bbox": [left, top, right - left, bottom - top], "area": int(mask.sum())}
                    outline = {"segmentation": {"size": [height, width], "counts": runs.tolist()}}
                    annotations.append({"id": len(annotations) + 1, **owner, **place, **outline})
    names = [{"id": number, "name": name} for number, name in enumerate(assets, start=1)]
    content = {"images": images, "annotations": annotations, "categories": names}
    write_json(run.directory / "annotations.json", content, indent=None)
    run.write_metrics({"scenes": len(batch), "images": len(images), "annotations": len(annotations)})
    run.say(f"{len(images)} views of {len(batch)} scenes, {len(annotations)} annotated objects: {run.directory}")


def _cameras(path: str) -> list[Any]:
    from scene_envs.render import Pinhole
    from scene_envs.scene_types import Camera

    try:
        entries = json.loads(Path(path).read_text()) if path else []
        if path and not (isinstance(entries, list) and entries):
            raise ValueError("it is no list of at least one camera")
        return [Pinhole(**entry) if "pose" in entry else Camera(**entry) for entry in entries]
    except (OSError, ValueError, TypeError) as error:
        raise InvalidInputError(f"cameras={path}: no JSON list of cameras could be read there: {error}") from None


def _pixels(mode: str, image: Any, assets: int) -> Any:
    """An image as a PNG holds it: depth in mm, slots and categories from 1, normals from 0 to 255; 0 without any."""
    import numpy as np

    if mode == "depth":
        return np.where(image < 65.535, np.rint(1000.0 * np.minimum(image, 65.535)), 0).astype(np.uint16)
    if mode in ("instance", "category"):
        return ((image + 1) % (assets + 1) if mode == "category" else image + 1).astype(np.uint16)
    return np.rint(127.5 * (image + 1.0)).astype(np.uint8) if mode == "normals" else image
