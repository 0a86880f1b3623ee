"""Planners of the search at equal NFE, their winners in another simulator, and the cost of the search itself.

    python benchmarks/search.py compare [--planners NAME[:key=value,...] ...] [--seeds 0 1 2] [--scenes 300]
                                        [--at 64 300] [--prior dimsum_table] [--objective feasible_objects]
                                        [--branching 3] [--num-steps 50] [--mask culprits] [--slots N] [--scale X]
                                        [--prompt TEXT] [--together 5] [--records FILE]
    python benchmarks/search.py curve --records FILE [--prior ...] [--mask ...] [--planners ...] --output FILE
    python benchmarks/search.py rest FILE ... [--simulator MuJoCo] [--duration 2]
    python benchmarks/search.py pictures FILE ... --output FILE
    python benchmarks/search.py crowding [--prior dimsum_table] [--samples 24] [--seed 0]
    python benchmarks/search.py overhead [--planners NAME ...] [--expansions 5000] [--scenes 64]

`compare` runs every planner with every seed and prints the best objective after as many scenes as `--at` says, median
and range over the seeds, after how many scenes runs found all there is, and CPU seconds per scene. `--together` seeds
run in common batches of the denoiser. `--records` keeps the curve of each run as one line of JSON, and the best scene
beside it; runs that are in the file already are not repeated. The first scenes of planners that do not steer the
denoising are the same for one seed. An objective or a mask with settings is given as JSON.

`curve` draws the curves of recorded runs, median and range.

`rest` exports scenes without the objects that physics calls infeasible, lets another simulator run, and counts the
objects that moved, and those outside the workspace. `pictures` draws scenes, with what the objective says of them.

`crowding` masks random slots of samples, or their culprits and some of their empty slots, inpaints once, and counts
objects.

`overhead` times 5,000 expansions on a problem that costs nothing, 1,000 at a time, and the share of a real search that
is neither the denoiser, the objective nor the mask.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.table import Table
from search_costs import CONSOLE, crowding, overhead
from search_winners import curve, pictures, rest

from agents.planning import Session, list_planners
from agents.planning.ledger import planner_settings
from scene_envs.envs import SearchEnv
from scene_envs.envs.scoring import resolve_prior
from scene_envs.scene import SceneBatch


def planner_of(text: str) -> dict[str, Any]:
    """``NAME:key=value,...`` as a mapping of settings."""
    name, _, keys = text.partition(":")
    return {
        "name": name,
        **{key: json.loads(value) for key, value in (word.split("=") for word in keys.split(",") if word)},
    }


def word(text: str) -> Any:
    """``text`` as it is, or the mapping that it holds as JSON."""
    return json.loads(text) if text.startswith("{") else text


def slug(key: dict[str, Any]) -> str:
    """A file name for a run."""
    words = (key["prior"], key["objective"], key["mask"], key["planner"], key["slots"], key["num_steps"], key["seed"])
    return re.sub(r"[^A-Za-z0-9_.=]+", "-", "-".join(map(str, words)))


def run_together(prior: Any, keys: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Records of runs that differ in their seed alone: in common batches of the denoiser, with the best scenes."""
    key = keys[0]
    planner = planner_of(key["planner"])
    settings = planner_settings(planner["name"])(**planner)
    env = SearchEnv(
        scene=prior.scene_type,
        prior=prior,
        objective=word(key["objective"]),
        mask=word(key["mask"]),
        slots=key["slots"],
        objective_scale=key["scale"],
        prompt=key["prompt"] and key["prompt"].replace("_", " "),
        num_steps=key["num_steps"],
        branching=max(key["scenes"], key["branching"]) if settings.widens else key["branching"],
        max_depth=1000,
    )
    empty, roots = SceneBatch.empty(prior.scene_type, 1, env.problem.slots), []
    for each in keys:
        env.reset(seed=each["seed"], options={"scene": empty})
        roots.append(env.clone_state())
    session = Session(env)
    begun = time.process_time()

    def told(done: int, best: float) -> None:
        if done % 50 < len(keys) * key["branching"]:
            print(f"  {done} scenes, the worst search has {best:.3f}", flush=True)

    plans = session.run(settings.make(key["branching"]), roots, key["scenes"], told)
    if session.stopped:
        sys.exit(session.stopped)
    seconds = (time.process_time() - begun) / sum(len(plan.values) for plan in plans)
    env.close()
    return [
        {
            **each,
            "curve": [env.problem.scale * value for value in plan.curve],
            "objective_found": plan.best_state.objective,
            "maximum": env.problem.scale,
            "seconds_per_scene": seconds,
            "together": len(keys),
            "best": env.scene(plan.best_state),
        }
        for each, plan in zip(keys, plans, strict=True)
    ]


def compare(options: argparse.Namespace) -> None:
    """Run the searches that are not recorded, and print the table."""
    prior, records = resolve_prior(options.prior), Path(options.records)
    known = [json.loads(line) for line in records.read_text().splitlines()] if records.exists() else []
    names = ("prior", "objective", "branching", "num_steps", "mask", "scenes", "slots", "scale", "prompt")
    common = {name: getattr(options, name) for name in names}

    def same(record: dict[str, Any], key: dict[str, Any]) -> bool:
        return all(record.get(name) == value for name, value in key.items())

    for planner in options.planners:
        keys = [{**common, "planner": planner, "seed": seed} for seed in options.seeds]
        keys = [key for key in keys if not any(same(record, key) for record in known)]
        for start in range(0, len(keys), options.together):
            for record in run_together(prior, keys[start : start + options.together]):
                best = record.pop("best")
                records.parent.mkdir(parents=True, exist_ok=True)
                best.save(records.parent / f"{slug(record)}.safetensors")
                known.append(record)
                with records.open("a") as file:
                    file.write(json.dumps(record) + "\n")
                curve = record["curve"]
                per = record["seconds_per_scene"]
                print(planner, record["seed"], f"{curve[-1]:g} after {len(curve)} scenes, {per:.3f} s each", flush=True)
    table = Table("planner", "seeds", *(f"after {at}" for at in options.at), "all of it after", "CPU s per scene")
    for planner in options.planners:
        runs = [r for r in known if same(r, {**common, "planner": planner}) and r["seed"] in options.seeds]
        if not runs:
            continue
        cells = []
        for at in options.at:
            values = [run["curve"][min(at, len(run["curve"])) - 1] for run in runs]
            cells.append(f"{statistics.median(values):g} ({min(values):g} to {max(values):g})")
        full = sorted(run["curve"].index(run["maximum"]) + 1 for run in runs if run.get("maximum") in run["curve"])
        cells.append(", ".join(map(str, full)))
        seconds = statistics.median(run["seconds_per_scene"] for run in runs)
        table.add_row(planner, str(len(runs)), *cells, f"{seconds:.3f}")
    CONSOLE.print(table)


COMMANDS = {
    "compare": compare,
    "curve": curve,
    "rest": rest,
    "pictures": pictures,
    "crowding": crowding,
    "overhead": overhead,
}


def main() -> None:
    """Read the words and run."""
    sys.path.append(str(Path(__file__).parents[1] / "examples"))
    import_module("planners")  # registers uct
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=COMMANDS)
    parser.add_argument("files", nargs="*")
    parser.add_argument("--planners", nargs="+", default=list_planners())
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--at", nargs="+", type=int, default=[64, 300])
    parser.add_argument("--prior", default="dimsum_table")
    parser.add_argument("--objective", default="feasible_objects")
    parser.add_argument("--branching", type=int, default=3)
    parser.add_argument("--num-steps", type=int, default=50)
    parser.add_argument("--mask", default="culprits")
    parser.add_argument("--records", default="runs/search/records.jsonl")
    parser.add_argument("--together", type=int, default=5)
    parser.add_argument("--slots", type=int)
    parser.add_argument("--prompt", help="of all scenes, with an underscore for each space")
    parser.add_argument("--scale", type=float)
    parser.add_argument("--samples", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--expansions", type=int, default=5000)
    parser.add_argument("--simulator", default="MuJoCo")
    parser.add_argument("--duration", type=float, default=2.0)
    parser.add_argument("--output", default="runs/search/picture.png")
    options = parser.parse_args()
    COMMANDS[options.what](options)


if __name__ == "__main__":
    main()
