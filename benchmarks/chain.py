"""Speed and memory of a chain: scenes per second with and without guidance, kernels per step, and precisions.

    python benchmarks/chain.py [--prior dimsum_table_feasible] [--device auto] [--batches 512 4096] [--num-steps 50]

Prints the card with its clocks as found, then one row for each batch size and setting: the median of three chains after
one that warms up (and that captures CUDA graphs, where there are any). ``plain`` launches kernels one by one, and
``guided`` has physics guidance. ``away`` is the mean distance of the objects of a precision from those of float32 with
the same seed, in scenes that hold the same objects. Takes less than eight minutes on a GPU; on a CPU, take small ones.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch
from rich.console import Console
from rich.table import Table
from torch.profiler import ProfilerActivity, profile

from agents.networks.denoisers import Replays
from agents.priors.prior import ScenePrior
from scene_envs.arrays import resolve_device
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

_REPEATS = 3
_PROFILED = 4
"""Steps of the chain whose kernels are counted."""


def card(device: torch.device) -> str:
    """Name of the device, and its clocks, power and temperature as they are."""
    if device.type != "cuda":
        return f"{device}, {torch.get_num_threads()} threads"
    query = "name,clocks.sm,clocks.mem,clocks.max.sm,power.draw,temperature.gpu"
    command = ["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader", f"--id={device.index or 0}"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def seconds(work: Callable[[], object], device: torch.device) -> list[float]:
    """Seconds of several calls after one that does not count."""
    result = []
    for _ in range(1 + _REPEATS):
        begun = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        result.append(time.perf_counter() - begun)
    return result[1:]


def kernels_per_step(work: Callable[[int], object], device: torch.device) -> tuple[float, float]:
    """Kernels (on a CPU, operators) of a step of a chain, and their milliseconds."""
    on_gpu = device.type == "cuda"
    with profile(activities=[ProfilerActivity.CUDA if on_gpu else ProfilerActivity.CPU]) as profiled:
        work(_PROFILED)
        if on_gpu:
            torch.cuda.synchronize(device)
    events = profiled.key_averages()
    spent = sum(event.self_device_time_total if on_gpu else event.self_cpu_time_total for event in events)
    return sum(event.count for event in events) / _PROFILED, spent / 1e3 / _PROFILED


def distance(found: SceneBatch, exact: SceneBatch) -> float:
    """Mean distance (mm) of the objects of two batches, in the scenes that hold the same objects; NaN for none."""
    same = (found.categories == exact.categories).all(dim=1, keepdim=True) & ~exact.is_empty
    return 1e3 * float((found.translations - exact.translations).norm(dim=-1)[same].mean())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", default="dimsum_table_feasible")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--batches", type=int, nargs="+", default=[512, 4096])
    parser.add_argument("--num-steps", type=int, default=50)
    options = parser.parse_args()
    device = torch.device(resolve_device(options.device))
    prior = ScenePrior.load(options.prior).to(device)
    graphs, plain = prior.denoiser.replays, Replays(on="none")
    table = Table(
        "batch", "setting", "scenes/s", "spread", "ms/step", "kernels/step", "kernels, ms/step", "MiB", "away, mm"
    )
    console = Console(width=140)
    console.print(card(device))
    for batch in options.batches:
        exact: SceneBatch | None = None
        for name in ("plain", "float32", "guided", "tf32", "bfloat16"):
            try:
                prior.with_precision(name if name in ("tf32", "bfloat16") else "float32")
            except InvalidInputError as error:
                console.print(str(error))
                continue
            prior.denoiser.replays = plain if name == "plain" else graphs

            def draw(steps: int, size: int = batch, guidance: float = float(name == "guided")) -> SceneBatch:
                return prior.sample(size, num_steps=steps, seed=0, batch_size=size, physics_guidance=guidance)

            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device)
            spent = seconds(lambda: draw(options.num_steps), device)
            peak = torch.cuda.max_memory_allocated(device) / 2**20 if device.type == "cuda" else float("nan")
            count, busy = kernels_per_step(draw, device)
            scenes = draw(options.num_steps).to("cpu")
            exact = scenes if exact is None else exact
            middle = statistics.median(spent)
            row = (
                str(batch),
                name,
                f"{batch / middle:,.0f}",
                f"{(max(spent) - min(spent)) / middle:.0%}",
                f"{1e3 * middle / options.num_steps:.2f}",
                f"{count:,.0f}",
                f"{busy:.2f}",
                f"{peak:,.0f}",
                "" if name == "guided" else f"{distance(scenes, exact):.2f}",
            )
            table.add_row(*row)
    console.print(table)
    console.print(card(device))


if __name__ == "__main__":
    main()
