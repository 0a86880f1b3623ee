"""Digests of seeded results, compared with those that an earlier state of the code gave.

    python benchmarks/same_numbers.py [--write] [--only NAME]

Computes samples of every shipped prior, completion, rearrangement, log-probabilities, tiny training runs, an imported
checkpoint and a tiny search, on one CPU thread, and compares them with ``same_numbers.json``. Equal means equal in
every bit. Prints a table of differences and exits with 1 if there are any. ``--write`` takes the new figures: on
another machine, or after a change that is meant to change numbers.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ["OMP_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch
from torch import Tensor

from agents import (
    PostTrainConfig,
    PretrainConfig,
    ScenePrior,
    SearchConfig,
    list_priors,
    post_train,
    pretrain,
    run_search,
)
from agents.priors import import_checkpoint
from scene_envs.datasets.prompts import describe_all
from scene_envs.scene import SceneBatch
from tests.helpers.authors_flux import random_state, write_checkpoint

FILE = Path(__file__).with_suffix(".json")
Figures = dict[str, Any]
_TIMES = ("seconds",)
"""Columns of logs that hold times."""


def digest(*tensors: Tensor) -> str:
    """The first 16 digits of SHA-256 over the float32 bytes of tensors."""
    hashed = hashlib.sha256()
    for tensor in tensors:
        hashed.update(tensor.detach().cpu().float().contiguous().numpy().tobytes())
    return hashed.hexdigest()[:16]


def scene_figures(batch: SceneBatch) -> Figures:
    """Digest, mean number of objects and mean absolute coordinate of their translations."""
    objects = batch.translations[~batch.is_empty]
    return {
        "digest": digest(batch.tensor),
        "mean_count": round(float(batch.counts.float().mean()), 3),
        "mean_abs_translation": round(float(objects.abs().mean()), 6) if len(objects) else None,
    }


def weight_figures(prior: ScenePrior) -> Figures:
    """Digest and mean magnitude of the weights, whatever they are called."""
    tensors = [tensor.float() for tensor in prior.weights().values()]
    total = sum(float(tensor.abs().double().sum()) for tensor in tensors)
    return {"weights": digest(*tensors), "mean_abs_weight": total / sum(tensor.numel() for tensor in tensors)}


def log_figures(file: Path) -> Figures:
    """The last row of a log, and a digest of all rows without times."""
    with file.open(newline="") as opened:
        rows = [{key: value for key, value in row.items() if key not in _TIMES} for row in csv.DictReader(opened)]
    text = json.dumps(rows)
    return {"log": hashlib.sha256(text.encode()).hexdigest()[:16], "rows": len(rows), "last": rows[-1]}


def sampling(name: str) -> Figures:
    """Two scenes in ten steps, without a prompt, and with one and guidance where the prior reads prompts."""
    prior = ScenePrior.load(name)
    batch = prior.sample(2, num_steps=10, seed=3, physics_guidance=0.0)
    figures = {"free": scene_figures(batch)}
    if prior.conditional:
        import numpy as np

        prompts = [texts[0] for texts in describe_all(batch, np.random.default_rng(0), count=1)]
        figures["prompted"] = scene_figures(
            prior.sample(2, prompt=prompts, guidance=1.0, physics_guidance=0.0, num_steps=10, seed=4)
        )
    return figures


def inpainting(name: str) -> Figures:
    """Completion with more slots, and rearrangement, of two samples."""
    prior = ScenePrior.load(name)
    batch = prior.sample(2, num_steps=5, seed=3, physics_guidance=0.0)
    slots = batch.tensor.shape[1] + 4
    return {
        "complete": scene_figures(prior.complete(batch, num_steps=5, seed=1, slots=slots, physics_guidance=0.0)),
        "rearrange": scene_figures(prior.rearrange(batch, num_steps=5, seed=2, physics_guidance=0.0)),
    }


def log_probabilities(name: str) -> Figures:
    """Log-probabilities of the steps of a chain of six, per slot."""
    prior = ScenePrior.load(name)
    generator = torch.Generator().manual_seed(5)
    table, values = prior.step_table(6), []
    with torch.no_grad():
        x = prior.initial(2, prior.config.slots, generator)
        for step in range(len(table) - 1):
            reverse = prior.transition(x, step, table)
            x = reverse.from_noise(torch.randn(x.shape, generator=generator))
            values.append(reverse.log_prob(x))
    result = torch.stack(values)
    return {"digest": digest(result), "mean": float(result.mean())}


def pretraining(process: str) -> Figures:
    """Five steps on fresh scenes of a grammar; the mixed prior learns to read prompts."""
    encoder = "vocabulary" if process == "mixed" else "none"
    with TemporaryDirectory() as output:
        config = PretrainConfig(
            data="grammar", output=output, iterations=5, batch_size=8, seed=7, process=process,
            optimizer={"rate": {"warmup": 2}},
            network={"hidden": 32, "depth": 2, "heads": 2},
            logger={"log_every": 1, "evaluate_every": 5, "checkpoint_every": 5},
            text={"encoder": encoder, "vocabulary": {"width": 32, "depth": 1, "latents": 4, "warmup": 3}},
        )  # fmt: skip
        pretrain(config)
        prior = ScenePrior.load(output)
        return log_figures(Path(output) / "log.csv") | weight_figures(prior)


def post_training(name: str) -> Figures:
    """Two iterations toward more objects."""
    with TemporaryDirectory() as output:
        config = PostTrainConfig(
            prior=name, reward="object_count", output=output, iterations=2, batch_size=4, num_steps=4, seed=11,
            algorithm={"gradient_steps": 2}, regularisation={"batch_size": 4, "bank_size": 24},
            guard={"scenes": 8, "every": 1, "limit": 100.0}, logger={"checkpoint_every": 2}, progress="none",
        )  # fmt: skip
        result = post_train(config)
        return log_figures(Path(output) / "log.csv") | weight_figures(result.prior)


def checkpoint_import(text: int) -> Figures:
    """A synthetic checkpoint under the authors' names, imported and sampled."""
    with TemporaryDirectory() as folder:
        files = write_checkpoint(Path(folder), random_state(text=text))
        prior = import_checkpoint(*files, scene="dimsum_table")
    return weight_figures(prior) | scene_figures(prior.sample(2, num_steps=4, seed=0))


def search(name: str) -> Figures:
    """A search for many objects, and best of N beside it."""
    config = SearchConfig(planner="evolution", budget=8, branching=2, max_depth=3, num_steps=4, mask="random", seed=2)
    outcome = run_search(name, "object_count", config=config)
    return {
        "values": outcome.search.values,
        "best_of": outcome.best_of.values,
        "path": list(outcome.search.best_path),
        "best": scene_figures(outcome.best),
        "first": scene_figures(outcome.first),
    }


def cases() -> dict[str, Callable[[], Figures]]:
    """The computations, by name."""
    result: dict[str, Callable[[], Figures]] = {}
    for name in list_priors():
        result[f"sample {name}"] = lambda name=name: sampling(name)  # type: ignore[misc]
    for process, name in (("continuous", "dimsum_table_continuous"), ("mixed", "dimsum_table")):
        result[f"inpaint {process}"] = lambda name=name: inpainting(name)  # type: ignore[misc]
        result[f"log_prob {process}"] = lambda name=name: log_probabilities(name)  # type: ignore[misc]
        result[f"pretrain {process}"] = lambda process=process: pretraining(process)  # type: ignore[misc]
        result[f"post_train {process}"] = lambda name=name: post_training(name)  # type: ignore[misc]
    result["import"] = lambda: checkpoint_import(0)
    result["search"] = lambda: search("dimsum_table")
    return result


def flat(figures: Any, prefix: str = "") -> dict[str, str]:
    """Leaves of nested figures by dotted name."""
    if not isinstance(figures, dict):
        return {prefix: json.dumps(figures)}
    return {
        key: value for name, part in figures.items() for key, value in flat(part, f"{prefix} {name}".strip()).items()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="take the new figures")
    parser.add_argument("--only", default="", help="compute the cases whose name contains this")
    options = parser.parse_args()
    torch.set_num_threads(1)
    chosen = {name: compute for name, compute in cases().items() if options.only in name}
    if not chosen:
        parser.error(f"--only {options.only!r} names no case; the cases are {', '.join(cases())}")
    found = {name: json.loads(json.dumps(compute())) for name, compute in chosen.items()}
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    if options.write:
        FILE.write_text(json.dumps(known | found if options.only else found, indent=1) + "\n")
        print(f"wrote {len(found)} cases to {FILE.name}")
        return 0
    before, now = flat({name: known[name] for name in chosen if name in known}), flat(found)
    different = [key for key in sorted(before.keys() | now.keys()) if before.get(key) != now.get(key)]
    for key in different:
        print(f"{key}: was {before.get(key)}, is {now.get(key)}")
    print(f"{len(now) - len(different)} of {len(now)} figures are equal")
    return 1 if different else 0


if __name__ == "__main__":
    raise SystemExit(main())
