"""Trials of files with damaged bytes."""

from __future__ import annotations

import logging
import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from benchmarks.reliability.figures import Figures
from benchmarks.reliability.small_commands import place

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior

_CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8\n"""
_URDF = """<robot name="cube"><link name="body"><inertial><mass value="0.2"/><inertia ixx="0.01" iyy="0.01" izz="0.01"
ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry><mesh filename="cube.obj" scale="0.1 0.1 0.1"/></geometry>
</collision></link></robot>"""


@dataclass(frozen=True)
class _Kind:
    """A file, the function that reads it, and whether it has a digest; a file without may be read with other values."""

    path: Path
    read: Callable[[], bytes]
    has_digest: bool


def fuzzed_files(count: int, seed: int = 0) -> Figures:
    """Flipped, cut and replaced bytes in every file that is read back.

    Each damaged file must be refused by name, in the project's own words, or be read with the same values. Files that
    people may edit by hand carry no digest; they may be read with other values.
    """
    from scene_envs.errors import SceneEnvsError

    rng, figures = random.Random(seed), Figures()
    logging.getLogger("scene_envs").setLevel(logging.CRITICAL)
    with TemporaryDirectory() as folder:
        kinds = _kinds(Path(folder))
        for number in range(count):
            kind = kinds[number % len(kinds)]
            path = kind.path
            whole, expected = path.read_bytes(), kind.read()
            path.write_bytes(_damaged(whole, rng))
            figures.tried += 1
            try:
                if kind.read() != expected and kind.has_digest:
                    figures.different += 1
                    figures.note(f"{path.name}: read with other values")
            except SceneEnvsError as error:
                if path.name not in str(error) and str(path.parent) not in str(error):
                    figures.silent += 1
                    figures.note(f"{path.name} is not named: {error}")
            except BaseException as error:
                figures.silent += 1
                figures.note(f"{path.name}: {type(error).__name__}: {error}")
            path.write_bytes(whole)
    return figures


def _kinds(folder: Path) -> list[_Kind]:
    import torch

    from agents.planning.output import SearchRecord
    from agents.priors.prior import ScenePrior
    from agents.utils.checkpoints import load_checkpoint, save_checkpoint
    from scene_envs import SceneBatch
    from scene_envs.assets import load_library
    from scene_envs.datasets import SceneDataset

    shutil.copytree(f"{place()}/mixed", folder / "prior")
    shutil.copytree(f"{place()}/data", folder / "data")
    SceneBatch.empty("dimsum_table", 4).save(folder / "scenes.safetensors")
    save_checkpoint(folder / "checkpoint.pt", {"weights": torch.arange(2000.0)})
    SearchRecord({"seed": 0}, [], []).save(folder / "tree.json")
    (folder / "assets").mkdir()
    (folder / "assets/cube.obj").write_text(_CUBE)
    (folder / "models").mkdir()
    (folder / "models/cube.obj").write_text(_CUBE)
    (folder / "models/cube.urdf").write_text(_URDF)

    def prior() -> bytes:
        return _weights(ScenePrior.load(folder / "prior"))

    def data() -> bytes:
        return SceneDataset.load(folder / "data").batch().tensor.numpy().tobytes()

    def assets(name: str) -> Callable[[], bytes]:
        return lambda: b"".join(part.vertices.tobytes() for asset in load_library(folder / name) for part in asset.fine)

    return [
        _Kind(folder / "prior/model.safetensors", prior, True),
        _Kind(
            folder / "scenes.safetensors",
            lambda: SceneBatch.load(folder / "scenes.safetensors").tensor.numpy().tobytes(),
            True,
        ),
        _Kind(
            folder / "checkpoint.pt",
            lambda: load_checkpoint(folder / "checkpoint.pt")["weights"].numpy().tobytes(),
            True,
        ),
        _Kind(folder / "data/scenes-00000.parquet", data, True),
        _Kind(folder / "tree.json", lambda: repr(SearchRecord.load(folder / "tree.json")).encode(), True),
        _Kind(folder / "prior/config.json", prior, True),
        _Kind(folder / "data/metadata.json", data, True),
        _Kind(folder / "assets/cube.obj", assets("assets"), False),
        _Kind(folder / "models/cube.urdf", assets("models"), False),
    ]


def _weights(prior: ScenePrior) -> bytes:
    return b"".join(tensor.detach().float().numpy().tobytes() for tensor in prior.state_dict().values())


def _damaged(whole: bytes, rng: random.Random) -> bytes:
    kind = rng.choice(("flip", "flip", "cut", "zeros", "append", "digits"))
    if kind == "cut":
        return whole[: rng.randrange(len(whole))]
    if kind == "append":
        return whole + rng.randbytes(rng.randrange(1, 64))
    content, start = bytearray(whole), rng.randrange(len(whole))
    if kind == "flip":
        content[start] ^= 1 << rng.randrange(8)
    elif kind == "digits":
        content[start : start + 1] = b"9" * rng.choice((1, 9, 30))
    else:
        content[start : start + 64] = bytes(len(content[start : start + 64]))
    return bytes(content)
