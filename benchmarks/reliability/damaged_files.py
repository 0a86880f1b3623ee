"""Trials of files with damaged bytes."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.reliability.figures import Figures

if TYPE_CHECKING:
    from torch import Tensor

    from agents.priors.base import ScenePrior


def fuzzed_files(count: int, seed: int = 0) -> Figures:
    """Flipped, cut and replaced bytes in every file that is read back: refused by name, or nothing has changed."""
    import torch

    from agents.priors.base import ScenePrior
    from agents.priors.testing import tiny_prior
    from agents.utils.checkpoints import load_checkpoint, save_checkpoint
    from scene_envs import SceneBatch
    from scene_envs.datasets import SceneDataset, generate
    from scene_envs.errors import SceneEnvsError

    rng, figures = random.Random(seed), Figures()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        tiny_prior().save(folder / "prior")
        SceneBatch.empty("dimsum_table", 4).save(folder / "scenes.safetensors")
        save_checkpoint(folder / "checkpoint.pt", {"weights": torch.arange(2000.0)})
        generate("dimsum_table", 4, folder / "data", workers=0, verify=False, progress=False)
        readers: dict[Path, Callable[[], Tensor]] = {
            folder / "prior/model.safetensors": lambda: _weights(ScenePrior.load(folder / "prior")),
            folder / "scenes.safetensors": lambda: SceneBatch.load(folder / "scenes.safetensors").tensor,
            folder / "checkpoint.pt": lambda: load_checkpoint(folder / "checkpoint.pt")["weights"],
            folder / "data/scenes-00000.parquet": lambda: SceneDataset.load(folder / "data").batch().tensor,
        }
        for number in range(count):
            path = list(readers)[number % len(readers)]
            whole, expected = path.read_bytes(), readers[path]()
            path.write_bytes(_damaged(whole, rng))
            figures.tried += 1
            try:
                if not torch.equal(readers[path](), expected):
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


def _weights(prior: ScenePrior) -> Tensor:
    import torch

    return torch.cat([tensor.detach().flatten().float() for tensor in prior.state_dict().values()])


def _damaged(whole: bytes, rng: random.Random) -> bytes:
    kind = rng.choice(("flip", "flip", "cut", "zeros", "append"))
    if kind == "cut":
        return whole[: rng.randrange(len(whole))]
    if kind == "append":
        return whole + rng.randbytes(rng.randrange(1, 64))
    content, start = bytearray(whole), rng.randrange(len(whole))
    if kind == "flip":
        content[start] ^= 1 << rng.randrange(8)
    else:
        content[start : start + 64] = bytes(len(content[start : start + 64]))
    return bytes(content)
