"""Reliability of commands and files: kills, fuzzed input, hostile rewards, full disks, two writers.

``python benchmarks/reliability.py [kills=N] [lines=N] [files=N] [rewards=N] [full=N] [writers=N]`` tries each so many
times, one process at a time, and prints a table: how often it was tried, and in how many a finished state was lost, a
result differed, or something wrong was not told. The last three should be 0. It needs no network; full disks need the
right to mount a tmpfs.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import io
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from agents.priors.base import ScenePrior

POST = (
    "post-train", "reward=object_count", "num_steps=6", "batch_size=4", "iterations=5", "algorithm.gradient_steps=1",
    "regularisation.batch_size=2", "regularisation.bank_size=12", "guard.scenes=4", "guard.every=2", "slots=6",
    "logger.checkpoint_every=1", "logger.report_scenes=0", "logger.progress=none",
)  # fmt: skip
PRETRAIN = (
    "pretrain", "data=DATA", "iterations=6", "batch_size=4", "network.hidden=16",
    "network.depth=1", "network.heads=2", "logger.checkpoint_every=1", "logger.evaluate_every=3", "logger.log_every=1",
)  # fmt: skip
GENERATE = ("generate", "count=40", "shard_size=10", "workers=0", "verify=false", "progress=false")
RESUMABLE = {"post-train": POST, "pretrain": PRETRAIN, "generate": GENERATE}
RESULTS = {
    "post-train": ("prior/model.safetensors", "log.csv"),
    "pretrain": ("prior/model.safetensors", "log.csv"),
    "generate": ("scenes-00000.parquet", "scenes-00003.parquet", "metadata.json"),
}
NASTY = (
    "", "0", "-1", "1e999", "nan", "-inf", "null", "true", "9" * 30, "9" * 5000, "a", "a" * 300, "../" * 40, "/",
    "/proc", "[]", "[[[[[[[[1]]]]]]]]", "{}", "{name: }", "{a: {b: {c: 1}}}", "[1,2", "${oc.env:HOME}", "${x}",
    "'", '"', "\\", "a=b", "1,2,3", "é\u202e😀", "\x00", "\n", "*", "~", "!!python/object:os.system", "1_000", "0x10",
    "1e3", ".5", "None",
)  # fmt: skip
"""Values that no key expects, or that some treat in their own way."""


@dataclass
class Figures:
    """Outcome of one kind of trial.

    Attributes:
        tried: how many.
        lost: a finished state was gone, or a run could not go on.
        different: a result was not that of an undisturbed run.
        silent: something wrong was told as success, or not in the project's own words.
        notes: the first cases, for whoever looks into them.
    """

    tried: int = 0
    lost: int = 0
    different: int = 0
    silent: int = 0
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Remember a case, if there are not many yet."""
        if len(self.notes) < 20:
            self.notes.append(text[:600])


def command(*words: str) -> list[str]:
    """The process of a command; ``data=DATA`` stands for a small dataset."""
    filled = [word if word != "data=DATA" else f"data={dataset()}" for word in words]
    return [sys.executable, "-m", "agents.cli", *filled]


@cache
def dataset() -> str:
    """A small dataset, made once."""
    place = tempfile.TemporaryDirectory()
    atexit.register(place.cleanup)
    subprocess.run(command(*GENERATE, f"output={place.name}/data"), check=True, capture_output=True)
    return f"{place.name}/data"


def run_here(words: Sequence[str]) -> tuple[int, str]:
    """Exit status and messages of a command in this process."""
    from agents.cli import main

    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        status = main(list(words))
    return status, err.getvalue()


# -- kills ----------------------------------------------------------------------------------------------------------


def kills(count: int, number: signal.Signals = signal.SIGKILL, seed: int = 0) -> Figures:
    """Kill resumable commands at random moments until they end; results are compared with an undisturbed run's."""
    figures, rng = Figures(), random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        expected, seconds = {}, {}
        for name, words in RESUMABLE.items():
            started = time.monotonic()
            subprocess.run(command(*words, f"output={place}/{name}"), check=True, capture_output=True)
            seconds[name] = time.monotonic() - started
            expected[name] = _digests(Path(place) / name, RESULTS[name])
        trial = 0
        while figures.tried < count:
            name = sorted(RESUMABLE)[trial % len(RESUMABLE)]
            trial += 1
            _kill_until_done(name, Path(place) / f"{name}-{trial}", number, rng, seconds[name], expected[name], figures)
    return figures


def _kill_until_done(
    name: str, folder: Path, number: signal.Signals, rng: random.Random, seconds: float, expected: dict[str, str],
    figures: Figures,
) -> None:  # fmt: skip
    words = command(*RESUMABLE[name], f"output={folder}")
    for _ in range(3):
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(rng.uniform(0.3, 1.1) * seconds)
        if process.poll() is not None:
            break
        process.send_signal(number)
        status = process.wait()
        figures.tried += 1
        if number == signal.SIGTERM and status not in (143, 0):
            figures.silent += 1
            figures.note(f"{name}: SIGTERM gave exit status {status}")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        figures.lost += 1
        figures.note(f"{name} did not go on: {done.stderr[-400:]}")
        return
    found = _digests(folder, expected)
    if found != expected:
        figures.different += 1
        figures.note(f"{name}: {[file for file in expected if found.get(file) != expected[file]]} differ")
    left = [path.name for path in folder.rglob(".*") if path.name.endswith((".partial", ".lock", ".journal"))]
    if left:
        figures.silent += 1
        figures.note(f"{name} left {left}")


def _digests(folder: Path, names: Sequence[str] | dict[str, str]) -> dict[str, str]:
    """Digests of results; of logs without the columns that hold times."""
    found = {}
    for name in names:
        content = (folder / name).read_bytes() if (folder / name).exists() else b"none"
        if name.endswith(".csv"):
            rows = [line.split(",") for line in content.decode().splitlines()]
            keep = [index for index, column in enumerate(rows[0]) if "seconds" not in column] if rows else []
            content = repr([[row[index] for index in keep] for row in rows]).encode()
        found[name] = hashlib.sha256(content).hexdigest()
    return found


# -- input ----------------------------------------------------------------------------------------------------------


def fuzzed_lines(count: int, seed: int = 0) -> Figures:
    """Command lines with values that no key expects: each is done, or refused in the project's own words."""
    from importlib import import_module

    from agents.cli.commands import COMMANDS
    from agents.cli.keys import describe_fields

    rng, figures = random.Random(seed), Figures()
    names = [name for name in COMMANDS if name not in ("demo", "pretrain", "evaluate", "generate")]
    keys = {
        name: [key.name for key in describe_fields(import_module(_module(name)).config()) if key.name != "output"]
        for name in COMMANDS
    }
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = rng.choice(list(COMMANDS) if number % 2 else names)
            base = [] if number % 2 else list(_small(keys[name]))
            chosen = rng.sample(keys[name], min(len(keys[name]), rng.choice((1, 1, 2)))) or ["seed"]
            line = [name, *base, *(f"{key}={rng.choice(NASTY)}" for key in chosen)]
            line += ["--cfg", "job"] if number % 2 else [f"output={place}/{number}"]
            _judge_line(line, figures)
            shutil.rmtree(f"{place}/{number}", ignore_errors=True)
    return figures


def _small(keys: Sequence[str]) -> Iterator[str]:
    """Words that make a command quick."""
    words = {
        "count": "1", "num_steps": "1", "workers": "0", "pictures": "0", "slots": "6", "budget": "2", "branching": "2",
        "iterations": "1", "batch_size": "2", "algorithm.gradient_steps": "1", "regularisation.bank_size": "6",
        "regularisation.batch_size": "2", "guard.scenes": "2", "logger.report_scenes": "0", "logger.progress": "none",
        "reward": "object_count", "objective": "object_count",
    }  # fmt: skip
    yield from (f"{key}={value}" for key, value in words.items() if key in keys)


def _module(name: str) -> str:
    return f"agents.cli.commands.{name.replace('-', '_')}"


def _judge_line(line: list[str], figures: Figures) -> None:
    figures.tried += 1
    shown = " ".join(word if len(word) < 60 else word[:60] + "..." for word in line)
    try:
        status, err = run_here(line)
    except BaseException as error:  # nothing may come through
        figures.silent += 1
        figures.note(f"{shown}: {type(error).__name__}: {error}")
        return
    if "something unexpected" in err or "Traceback" in err or (status and not err.strip()) or len(err) > 20_000:
        figures.silent += 1
        figures.note(f"{shown}: {err[-400:]}")


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


# -- rewards, disks, writers -------------------------------------------------------------------------------------------


def hostile_rewards(count: int, seed: int = 0) -> Figures:
    """Rewards that exit, hang, crash, fill memory or talk: invalid scenes and one short sentence, in time."""
    from rewards import IsolatedReward, allow_local_rewards, evaluate_reward
    from scene_envs import SceneBatch

    bodies = (
        "import sys; sys.exit(0)", "import os; os._exit(0)", "import os; os._exit(7)", "import time; time.sleep(1e6)",
        "import ctypes; ctypes.string_at(0)", "x = bytearray(2**31)", "raise ValueError('x' * 2**20)", "return None",
        "return torch.full((len(batch),), float('nan'))", "batch.tensor.numpy()[:] = 7; return batch.counts",
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "raise KeyboardInterrupt", "raise MemoryError",
        "def deep(n): return deep(n + 1)\n    return deep(0)",
        "import os; os.close(4); os.close(5); return batch.counts",
        "while True: pass",
    )  # fmt: skip
    rng, figures = random.Random(seed), Figures()
    batch = SceneBatch.empty("dimsum_table", 3)
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            body = bodies[number % len(bodies)]
            at_import = rng.random() < 0.2 and "return" not in body and "batch" not in body
            path = Path(place) / f"mine_{number}.py"
            outside, inside = (body, "return batch.counts") if at_import else ("", body)
            path.write_text(f"import torch\n{outside}\ndef mine(batch):\n    {inside}\n")
            allow_local_rewards(path)
            figures.tried += 1
            started = time.monotonic()
            try:
                with IsolatedReward(f"{path}:mine", timeout=4, memory=0.5) as reward:
                    output = evaluate_reward(reward, batch)
                told, lost = output.problem, not bool(output.is_valid.any())
            except Exception as error:
                told, lost = str(error), True
            if not lost or (not told and "nan" not in body) or len(told) > 2000 or time.monotonic() - started > 20:
                figures.silent += 1
                figures.note(f"{body!r}{' at import' * at_import}: {told!r} in {time.monotonic() - started:.1f} s")
    return figures


def full_disks(count: int, seed: int = 0) -> Figures:
    """Commands on a disk with a random number of bytes left: one sentence, no empty file, and they go on after."""
    rng, figures = random.Random(seed), Figures()
    lines = (POST, PRETRAIN, GENERATE, ("sample", "count=2", "num_steps=1", "workers=0", "reward=object_count"))
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            line = lines[number % len(lines)]
            size = int(4096 * 10 ** rng.uniform(0.3, 3.2))
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place], check=True)
            try:
                words = command(*line, f"output={place}/run")
                first = subprocess.run(words, capture_output=True, text=True, check=False)
                figures.tried += 1
                _judge_full(line[0], size, first, Path(place), figures)
                if first.returncode:
                    subprocess.run(["mount", "-o", "remount,size=512m", place], check=True)
                    again = subprocess.run(words, capture_output=True, text=True, check=False)
                    if again.returncode:
                        figures.lost += 1
                        figures.note(f"{line[0]} at {size} bytes did not go on: {again.stderr[-300:]}")
            finally:
                subprocess.run(["umount", place], check=True)
    return figures


def _judge_full(name: str, size: int, done: subprocess.CompletedProcess[str], place: Path, figures: Figures) -> None:
    told = [line for line in done.stderr.splitlines() if line.startswith("scene-envs: ")]
    empty = [
        path.name for path in place.rglob("*") if path.is_file() and not path.stat().st_size and path.name != "log.txt"
    ]
    bad = done.returncode and ("something unexpected" in done.stderr or "Traceback" in done.stderr or not told)
    if bad or empty:
        figures.silent += 1
        figures.note(f"{name} at {size} bytes: status {done.returncode}, empty {empty}: {done.stderr[-400:]}")


def two_writers(count: int, seed: int = 0) -> Figures:
    """Two processes with one folder: one of them works, the other is told who does."""
    rng, figures = random.Random(seed), Figures()
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = sorted(RESUMABLE)[number % len(RESUMABLE)]
            words = command(*RESUMABLE[name], f"output={place}/{number}")
            first = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            time.sleep(rng.uniform(0.0, 0.5))
            second = subprocess.run(words, capture_output=True, text=True, check=False)
            _, err = first.communicate()
            figures.tried += 1
            statuses = sorted((first.returncode, second.returncode))
            if statuses[0] != 0:
                figures.lost += 1
                figures.note(f"{name}: {statuses} {err[-300:]} {second.stderr[-300:]}")
            elif statuses[1] and "is being written by scene-envs" not in err + second.stderr:
                figures.silent += 1
                figures.note(f"{name}: {err[-300:]} {second.stderr[-300:]}")
    return figures


TRIALS: dict[str, Callable[[int], Figures]] = {
    "kills": kills,
    "terms": lambda count: kills(count, signal.SIGTERM, 1),
    "lines": fuzzed_lines,
    "files": fuzzed_files,
    "rewards": hostile_rewards,
    "full": full_disks,
    "writers": two_writers,
}
"""Kinds of trials by the word that says how many."""
COUNTS = {"kills": 300, "terms": 60, "lines": 10_000, "files": 10_000, "rewards": 100, "full": 100, "writers": 10}


def main(words: Sequence[str]) -> None:
    """Print a row per kind of trial, and the cases that went wrong."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    asked = {name: int(count) for name, _, count in (word.partition("=") for word in words)} or COUNTS
    print("| what | tried | lost | different | silent | seconds |\n|---|---|---|---|---|---|", flush=True)
    for name, count in asked.items():
        started = time.monotonic()
        found = TRIALS[name](count)
        row = (name, found.tried, found.lost, found.different, found.silent, round(time.monotonic() - started))
        print("| " + " | ".join(map(str, row)) + " |", flush=True)
        for note in found.notes:
            print(f"  {name}: {note}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
