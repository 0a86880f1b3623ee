"""Samples with and without physics guidance, as a table.

python benchmarks/physics_guidance.py --output FOLDER [--priors dimsum_table,living_room_shelf_feasible] [--count 500]
    [--strengths 0,1] [--picture PATH]

Each row is a run of ``scene-envs evaluate`` in a folder of its own, so that a second call continues where the first one
ended. All rows of a prior have the same noise. The table is also written to ``table.md``. ``--picture`` draws scenes of
the first prior, those with most faults without guidance: without it above, with it below, infeasible objects red.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import torch

from agents import ScenePrior
from agents.cli.main import main as scene_envs
from scene_envs.physics import feasibility
from scene_envs.render import gallery, picture_camera, render
from scene_envs.scene import SceneBatch

_COLUMNS = (
    "prior", "physics guidance", "free objects", "feasible share", "scenes without a fault", "scenes with a collision",
    "W₁ of counts", "classifier", "scenes per second",
)  # fmt: skip
_SHOWN = 4
_TIMED = 32
"""Scenes whose sampling is timed."""


def main() -> None:
    """Evaluate and print the table, or draw the picture."""
    arguments = _arguments()
    priors, strengths = arguments.priors.split(","), [float(text) for text in arguments.strengths.split(",")]
    if arguments.picture is not None:
        _draw(priors[0], arguments.picture)
        return
    lines = ["| " + " | ".join(_COLUMNS) + " |", "|---" * len(_COLUMNS) + "|"]
    for name in priors:
        for strength in strengths:
            lines.append(f"| `{Path(name).name}` | {strength:g} | {_row(name, strength, arguments)} |")
            (arguments.output / "table.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def _row(name: str, strength: float, arguments: argparse.Namespace) -> str:
    folder: Path = arguments.output / f"{Path(name).name}-{strength:g}"
    keys = {
        "prior": name, "count": arguments.count, "seed": 1, "physics_guidance": strength, "pictures": 0, "workers": 0,
        "measures": "[layout,physics,classifier]", "project": "false", "output": folder,
    }  # fmt: skip
    if scene_envs(["evaluate", *(f"{key}={value}" for key, value in keys.items())]):
        raise SystemExit(1)
    figures = json.loads((folder / "metrics.json").read_text())
    batch = SceneBatch.load(folder / "scenes.safetensors")
    classifier = f"{figures['classifier_accuracy']:.0%} ± {figures['classifier_accuracy_std']:.0%}"
    return " | ".join(
        [
            f"{figures['free_objects_mean']:.2f}",
            f"{figures['feasible_fraction']:.1%}",
            f"{_whole(batch):.1%}",
            f"{figures['collision_rate']:.1%}",
            f"{figures['count_wasserstein']:.2f}",
            classifier,
            f"{_speed(name, strength):.1f}",
        ]
    )


def _whole(batch: SceneBatch) -> float:
    """Share of the scenes in which all free objects are feasible."""
    return float((feasibility(batch).feasible | ~batch.is_free).all(dim=1).double().mean())


def _speed(name: str, strength: float) -> float:
    """Scenes per processor second."""
    prior = ScenePrior.load(name)
    prior.sample(1, num_steps=2, physics_guidance=strength)
    started = time.process_time()
    prior.sample(_TIMED, physics_guidance=strength)
    return _TIMED / (time.process_time() - started)


def _draw(name: str, path: Path) -> None:
    prior = ScenePrior.load(name)
    rows = [prior.sample(64, physics_guidance=strength, seed=3) for strength in (0.0, 1.0)]
    wrong = [batch.is_free & ~feasibility(batch).feasible for batch in rows]
    chosen = wrong[0].sum(dim=1).argsort(descending=True, stable=True)[:_SHOWN].sort().values
    scenes = SceneBatch.concatenate([batch[row : row + 1] for batch in rows for row in chosen.tolist()])
    camera = picture_camera(prior.scene_type.name, 400, 300)
    red = torch.cat([mask[chosen] for mask in wrong])
    gallery(render(scenes, camera=camera, width=400, height=300, highlight=red), columns=_SHOWN).save(path)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--priors", default="dimsum_table", help="names or folders of priors, joined by commas")
    parser.add_argument("--count", type=int, default=500, help="samples of each row")
    parser.add_argument("--strengths", default="0,1", help="values of physics_guidance, joined by commas")
    parser.add_argument("--output", type=Path, default=Path("runs/physics_guidance"), help="folder of the evaluations")
    parser.add_argument("--picture", type=Path, default=None, help="picture of scenes; nothing is evaluated")
    return parser.parse_args()


if __name__ == "__main__":
    main()
