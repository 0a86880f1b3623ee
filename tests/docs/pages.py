"""Code of the documentation: the fenced blocks of every page, and how each is made small enough for a test."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "agents/**/*.md")
    for path in ROOT.glob(pattern)
)
_FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)

SMALLER: dict[str, dict[str, str]] = {
    "docs/algorithms/ddpo_sf.md": {
        "iterations=40, ": "iterations=1, batch_size=2, num_steps=3, bank_size=16, guard_scenes=8, progress='none', ",
        'PostTrainConfig(output="runs/clutter")': (
            'PostTrainConfig(output="runs/compared", iterations=1, batch_size=2, num_steps=3, bank_size=16, '
            "guard_scenes=8, progress='none'), scenes=4, num_steps=3"
        ),
    },
    "docs/datasets.md": {
        '10_000, "data/dimsum_table", seed=0, workers=4': '4, "data/fresh", workers=0, progress=False',
        "stream.take(64)": "stream.take(4)",
        "batch_size=64": "batch_size=4",
        "scenes.scene_type, scenes.batch(), scenes.prompts": "break",
    },
    "docs/envs/README.md": {
        'DenoisingTorchRLEnv(32, reward="object_count", num_steps=50)': (
            'DenoisingTorchRLEnv(2, reward="object_count", num_steps=3)'
        ),
        'PPO("MultiInputPolicy", env).learn(1000)': (
            'PPO("MultiInputPolicy", env, n_steps=20, batch_size=10).learn(20)'
        ),
        "branching=8": "branching=2, num_steps=2",
        "range(5)": "range(1)",
    },
    "docs/evaluation.md": {"count=20, num_steps=10": "count=4, ready=False, num_steps=10", "workers=2": "workers=1"},
    "docs/evaluation_learned.md": {"seeds=10": "seeds=1"},
    "docs/grammars.md": {
        'prior="runs/tea_table"': (
            'prior=__import__("agents.priors.testing", fromlist=["tiny_prior"]).tiny_prior("tea_table")'
        ),
    },
    "docs/physics.md": {"workers=4": "workers=1"},
    "docs/search.md": {
        "budget=64, branching=4": "budget=3, branching=2, num_steps=2",
        "branching=4)": "branching=2, num_steps=2)",
        "budget=32": "budget=3",
    },
    "README.md": {"budget=32": "budget=3, branching=2, num_steps=2"},
}
"""Text of Python blocks, and what a test puts in its place: the same calls with smaller numbers."""

GIVEN: dict[str, tuple[str, ...]] = {
    "docs/assets.md": ("batch", "names"),
    "docs/evaluation_learned.md": ("real", "samples", "other_real"),
    "docs/grammars.md": ("gym",),
    "docs/physics.md": ("batch",),
    "docs/prompts.md": ("batch",),
    "docs/render.md": ("batch", "names"),
}
"""Names that a page speaks of without making them; :func:`given` makes them."""

SKIPPED: dict[tuple[str, str], str] = {
    ("docs/datasets.md", 'backend="ray", address="auto"'): "needs a Ray cluster that runs already",
}
"""Python blocks that no test can run, by page and a text in them, and why."""

PROGRAMS = {
    "make": "installs or runs the tests themselves; that its target exists is checked",
    "bash": "runs the tests themselves; that the script exists is checked",
    "hf": "downloads from the network",
    "torchrun": "needs eight GPUs; the command that it launches is read",
}
"""Shell commands that are not run, by program, and why."""

SMALL_KEYS: dict[str, dict[str, str]] = {
    "sample": {"count": "2", "num_steps": "3", "workers": "0"},
    "complete": {"num_steps": "3"},
    "rearrange": {"num_steps": "3"},
    "generate": {"count": "3", "workers": "0", "progress": "false"},
    "search": {"budget": "3", "num_steps": "2", "branching": "2"},
    "export": {"count": "2", "num_steps": "3", "workers": "0"},
    "view": {"count": "2", "num_steps": "3", "first": "0", "open": "false"},
    "priors": {},
    "rewards": {},
}
"""Commands that a test runs, and the keys that make them small; of others keys, values and names are checked."""


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: its file, from the root of the repository.
        line: where its code starts.
        language: what follows the fence.
        code: its text.
    """

    page: str
    line: int
    language: str
    code: str


def blocks_of(page: str) -> list[Block]:
    """The fenced blocks of ``page`` that name a language, in order."""
    text = (ROOT / page).read_text()
    return [Block(page, text[: found.start()].count("\n") + 2, found[1], found[2]) for found in _FENCE.finditer(text)]


def commands_of(block: Block) -> list[list[str]]:
    """The words of each command of a shell block, continued lines joined and comments left out."""
    lines = block.code.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def skipped(block: Block) -> str:
    """Why no test runs a Python block; empty for one that runs."""
    return next((why for (page, text), why in SKIPPED.items() if page == block.page and text in block.code), "")


def smaller(block: Block) -> str:
    """The code of a Python block with smaller numbers."""
    code = block.code
    for old, new in SMALLER.get(block.page, {}).items():
        code = code.replace(old, new)
    return code


def given(page: str) -> dict[str, Any]:
    """The names that ``page`` takes for granted: scenes ``batch`` with captions ``names``, three sets of scenes."""
    import gymnasium as gym

    from agents.evaluation import grammar_scenes

    if page not in GIVEN:
        return {}
    scenes = grammar_scenes("dimsum_table", 60, seed=0)
    values = {
        "batch": scenes[:2],
        "names": ["one", "two"],
        "real": scenes[:20],
        "samples": scenes[20:40],
        "other_real": scenes[40:],
        "gym": gym,
    }
    return {name: values[name] for name in GIVEN[page]}
