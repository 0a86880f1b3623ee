"""Winners of a search as replay in post-training, against post-training alone at the same NFE.

    python -m benchmarks.search_feeds_training output=FOLDER [prior=dimsum_table] [count=144] [budget=8]
                                               [iterations=36] [seed=0] [samples=512]

A search repairs each of `count` samples of the prior. It makes up to `budget` scenes; all but the first regenerate the
infeasible objects of the best scene so far. NFT with `feasible_share` then runs for `iterations` iterations, and the
winners of the search are replayed in half of each batch of its pretraining loss. The other run has no replay but more
iterations; the additional ones cost as many NFE as the search. Prints a table of fresh samples of both priors, of the
base prior, and of the winners. A second call goes on where the first ended.
"""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path

from agents.cli.main import main as scene_envs
from benchmarks.post_training.rows import SCENES, Row
from benchmarks.post_training.runs import kept_loss, measure, train
from benchmarks.post_training.tables import markdown
from scene_envs.errors import TrainingError
from scene_envs.scene import SceneBatch

STEPS = 25
"""Denoiser evaluations of a scene, in the search and in training."""
MEASURES = ("layout", "physics", "classifier")
COLUMNS = ("iterations", "free", "share", "loss", "count_wasserstein", "category_kl", "classifier")
DEFAULTS = {
    "output": "runs/search_feeds_training", "prior": "dimsum_table", "count": "144", "budget": "8", "iterations": "36",
    "seed": "0", "samples": "512",
}  # fmt: skip


def repaired(directory: Path, given: dict[str, str]) -> Path:
    """Folder of the search, run to its end."""
    folder = directory / "search"
    status = scene_envs([
        "search", f"prior={given['prior']}", "objective=feasible_share", "mask=infeasible", "planner=greedy",
        "branching=1", f"count={given['count']}", f"budget={given['budget']}", f"num_steps={STEPS}", "baseline=false",
        f"seed={given['seed']}", "side_by_side=48", f"output={folder}",
    ])  # fmt: skip
    if status:
        raise TrainingError(f"the search ended with status {status}; its message stands above")
    return folder


def main(words: list[str]) -> None:
    """Search, train twice, measure, print."""
    given = DEFAULTS | dict(word.split("=", 1) for word in words)
    directory = Path(given["output"])
    search = repaired(directory, given)
    found = json.loads((search / "metrics.json").read_text(encoding="utf-8"))
    worth = round(found["nfe"] / (SCENES * STEPS))
    keys = ("algorithm=nft", "reward=feasible_share", f"seed={given['seed']}", f"num_steps={STEPS}")
    short = int(given["iterations"])
    rows = {
        "search, then training": Row("fed", given["prior"], (*keys, f"regularisation.replay={search}"), short),
        "training alone": Row("alone", given["prior"], keys, short + worth),
    }
    samples = int(given["samples"])
    lines = [
        ("base prior", {**measure(given["prior"], directory / "figures" / "base", MEASURES, samples), "loss": 1.0})
    ]
    for label, row in rows.items():
        folder = train(row, directory, row.iterations, ())
        figures = measure(str(folder), directory / "figures" / row.name, MEASURES, samples)
        lines.append((label, {**figures, **kept_loss(folder), "iterations": row.iterations}))
    winners = SceneBatch.load(search / "best.safetensors")
    free = float(winners.is_free.sum(dim=-1).double().mean())
    share = statistics.mean(plan["objective"] for plan in found["searches"])
    lines.append(("winners of the search", {"free_objects_mean": free, "feasible_fraction": share}))
    print(f"The search cost {found['nfe']} NFE, as much as {worth} iterations.")
    print(markdown("Search feeds training", COLUMNS, lines))


if __name__ == "__main__":
    main(sys.argv[1:])
