"""Cost of sampling over that of its matrix products alone, and memory of the paper-size network.

    python benchmarks/sampling_cost.py [--prior dimsum_table] [--count 48] [--num-steps 25] [--memory]

Records every matrix product of a sampling run with the shapes and strides of its operands, and repeats the products
alone, in the same order and on one thread. ``--memory``: also the peak memory of processes that sample and post-train
the network of the paper's recipe at B = 32.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from agents.pretraining import PretrainConfig
from agents.pretraining.initial_prior import build_prior
from agents.priors.prior import ScenePrior
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer

PRODUCTS = {
    "aten::mm",
    "aten::addmm",
    "aten::bmm",
    "aten::baddbmm",
    "aten::_scaled_dot_product_flash_attention_for_cpu",
}
_REPEATS = 6
_BATCH = 32
_CLI = ("-m", "agents.cli")


class Products(TorchDispatchMode):
    """Context that records the matrix products of this thread.

    Attributes:
        calls: each product, ready to be repeated on operands of the same layout; equal ones share their operands.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Callable[[], Any]] = []
        self._ready: dict[str, Callable[[], Any]] = {}

    def __torch_dispatch__(
        self, function: Any, types: Sequence[type], args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        named = kwargs or {}
        with self:  # in inference mode, operations that consist of others come whole
            parts = function.decompose(*args, **named)
        if parts is not NotImplemented:
            return parts
        if function._schema.name in PRODUCTS:
            key = f"{function} {[_layout(arg) for arg in args]} { {name: _layout(arg) for name, arg in named.items()} }"
            if key not in self._ready:
                operands = [_alike(arg) for arg in args]
                options = {name: _alike(arg) for name, arg in named.items()}
                self._ready[key] = lambda: function(*operands, **options)
            self.calls.append(self._ready[key])
        return function(*args, **named)


def _layout(value: Any) -> Any:
    return (value.shape, value.stride(), value.dtype) if isinstance(value, Tensor) else value


def _alike(value: Any) -> Any:
    """Random numbers in the layout of a tensor; other values as they are."""
    if not isinstance(value, Tensor):
        return value
    extent = 1 + sum((size - 1) * stride for size, stride in zip(value.shape, value.stride(), strict=True))
    return torch.randn(extent).to(value.dtype).as_strided(value.shape, value.stride())


def sampling_seconds(prior: ScenePrior, count: int, num_steps: int) -> tuple[float, float, int]:
    """Processor seconds of sampling and of its products alone, least of several turns, and the number of products."""

    def sample() -> None:
        prior.sample(count, num_steps=num_steps, seed=0)

    with Products() as products:
        sample()

    def multiply() -> None:
        for product in products.calls:
            product()

    least = {sample: float("inf"), multiply: float("inf")}
    with torch.no_grad():
        for _ in range(_REPEATS):
            for work in least:
                begun = time.process_time()
                work()
                least[work] = min(least[work], time.process_time() - begun)
    return least[sample], least[multiply], len(products.calls)


def paper_size_memory() -> dict[str, float]:
    """Peak resident memory, MiB, of commands with the untrained network of the paper's recipe at B = 32."""
    few = ["regularisation.bank_size=64", "guard.scenes=32", "guard.samples=0", "logger.report_scenes=2"]
    common = ["num_steps=4", "seed=0", f"batch_size={_BATCH}"]
    with TemporaryDirectory() as folder:
        raw = get_grammar("dimsum_table").sample(np.random.default_rng(0), 64).tensor
        build_prior(PretrainConfig(recipe="paper"), raw, Normalizer.fit(raw)).save(folder)
        steered = ["algorithm=ddpo_sf", "reward=object_count", "iterations=1", *few]
        commands = {
            "none (`import torchrl`)": ["-c", "import torchrl"],
            "`sample`": [*_CLI, "sample", f"prior={folder}", f"count={_BATCH}", f"output={folder}/scenes", *common],
            "`post-train`": [*_CLI, "post-train", f"prior={folder}", f"output={folder}/run", *steered, *common],
        }
        return {name: _peak(command) for name, command in commands.items()}


def _peak(command: Sequence[str]) -> float:
    """Largest resident memory of a Python process, MiB, as Linux knows it just before the end."""
    process, peak = subprocess.Popen([sys.executable, *command], stdout=subprocess.DEVNULL), 0.0
    while process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        peak = max([peak, *(int(line.split()[1]) / 1024 for line in status.splitlines() if line.startswith("VmHWM"))])
        time.sleep(0.05)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    return peak


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prior", default="dimsum_table")
    parser.add_argument("--count", type=int, default=48)
    parser.add_argument("--num-steps", type=int, default=25)
    parser.add_argument("--memory", action="store_true", help="measure the memory of the paper-size network")
    options = parser.parse_args()
    torch.set_num_threads(1)
    whole, alone, number = sampling_seconds(ScenePrior.load(options.prior), options.count, options.num_steps)
    table = Table("prior", "scenes", "steps", "products", "sampling, s", "products alone, s", "ratio")
    row = (
        options.prior,
        options.count,
        options.num_steps,
        number,
        f"{whole:.2f}",
        f"{alone:.2f}",
        f"{whole / alone:.2f}",
    )
    table.add_row(*map(str, row))
    Console().print(table)
    if options.memory:
        peaks = Table("command at B = 32, paper-size network", "peak memory, MiB")
        for name, peak in paper_size_memory().items():
            peaks.add_row(name, f"{peak:,.0f}")
        Console().print(peaks)


if __name__ == "__main__":
    main()
