"""Code of the documentation: fenced blocks and inline commands of every page, and the sizes that tests give them."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    str(path.relative_to(ROOT))
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "agents/**/*.md")
    for path in ROOT.glob(pattern)
)
_FENCE = re.compile(r"^ *```(\w+)[^\n]*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"`((?:scene-envs|python|make|bash) [^`]+)`")

SMALLER: dict[str, dict[str, str]] = {
    "README.md": {"budget=32": "budget=2, branching=2, num_steps=20, slots=13"},
    "docs/algorithms/ddpo_sf.md": {
        'iterations=40, output="runs/more_objects"': (
            'iterations=1, batch_size=2, num_steps=3, **SMALL, output="runs/short"'
        ),
        "post_train_and_compare(config)": "post_train_and_compare(config, scenes=1, num_steps=20)",
        "scenes, steps = 32, 25": "scenes, steps = 2, 3",
        "range(40)": "range(2)",
    },
    "docs/datasets.md": {
        "10_000,": "12,",
        "workers=4)": "workers=0, progress=False)",
        "1_000_000": "2",
    },
    "docs/envs/README.md": {
        'DenoisingTorchRLEnv(32, reward="object_count", num_steps=50)': (
            'DenoisingTorchRLEnv(2, reward="object_count", num_steps=3)'
        ),
        "env.rollout(50, DenoisingPolicy(env.core.prior, 50))": "env.rollout(3, DenoisingPolicy(env.core.prior, 3))",
        'PPO("MultiInputPolicy", env).learn(1000)': (
            'PPO("MultiInputPolicy", env, n_steps=20, batch_size=10).learn(20)'
        ),
        "branching=8": "branching=2, num_steps=20, slots=13",
        "range(5)": "range(1)",
    },
    "docs/evaluation.md": {"count=20, num_steps=10": "count=2, num_steps=10", "workers=2": "workers=0"},
    "docs/evaluation_learned.md": {"seeds=10": "seeds=1"},
    "docs/physics.md": {"workers=4": "workers=0"},
    "docs/planners/best_of.md": {"branching=8": "branching=2", "budget=8": "budget=2"},
    "docs/planners/beam.md": {"budget=10": "budget=4"},
    "docs/planners/evolution.md": {"budget=10": "budget=6"},
    "docs/planners/greedy.md": {"children=3": "children=2", "budget=9": "budget=4"},
    "docs/planners/mcts.md": {"branching=3": "branching=2", "children=3": "children=2", "budget=9": "budget=4"},
    "docs/search.md": {
        "budget=64, branching=4": "budget=2, branching=2, num_steps=20, slots=13",
        "branching=4)": "branching=2, num_steps=20, slots=13)",
        "budget=32": "budget=2",
    },
}
"""Text of Python blocks, by page, and what a test puts in its place: the same calls with smaller numbers."""

SMALL: dict[str, dict[str, object]] = {
    "regularisation": {"bank_size": 16, "batch_size": 2},
    "guard": {"scenes": 4},
    "progress": "none",
}
"""Groups of a small post-training run, known to the Python blocks by this name."""

ROWS = "[flux_mixed,flux_mixed_text,flux_continuous]"
"""Rows of tables that are trained where a command asks for all."""

SMALL_KEYS: dict[str, dict[str, str]] = {
    "sample": {"count": "1", "num_steps": "20", "slots": "13", "workers": "0", "pictures": "1"},
    "complete": {"num_steps": "5"},
    "rearrange": {"num_steps": "5"},
    "generate": {"count": "12", "workers": "0", "progress": "none", "verify": "false"},
    "pretrain": {
        "iterations": "2",
        "batch_size": "2",
        "network.hidden": "32",
        "network.depth": "2",
        "network.heads": "2",
        "text.vocabulary.width": "16",
        "text.vocabulary.warmup": "2",
    },
    "post-train": {
        "iterations": "1",
        "batch_size": "2",
        "num_steps": "10",
        "slots": "20",
        "algorithm.gradient_steps": "2",
        "algorithm.scenes_per_prompt": "2",
        "regularisation.batch_size": "2",
        "regularisation.bank_size": "16",
        "guard.scenes": "4",
        "logger.report_scenes": "1",
        "workers": "0",
    },
    "doctor": {
        "batch_size": "2",
        "num_steps": "5",
        "slots": "13",
        "regularisation.bank_size": "16",
        "guard.scenes": "4",
    },
    "search": {"budget": "2", "count": "2", "num_steps": "20", "slots": "13", "branching": "2"},
    "evaluate": {"count": "2", "num_steps": "20", "training_scenes": "8", "prompt_count": "2", "workers": "0"},
    "export": {"count": "1", "num_steps": "20", "workers": "0"},
    "render": {"count": "1"},
    "view": {"count": "2", "num_steps": "3", "first": "0", "open": "false"},
    "import-checkpoint": {"count": "1", "num_steps": "2"},
    "benchmarks.paper_tables": {
        "size": "tiny",
        "iterations": "2",
        "count": "4",
        "workers": "0",
        "heldout": "{data}",
        "rows": "{rows}",
    },
}
"""Keys that make a command small, those that it has, whatever it was given: sizes, and what needs a screen.

``{data}`` is the value of that key, ``{rows}`` the first row of the pattern that was given, or ``ROWS``. Samples of
very few steps are tangled, which makes physics slow.
"""

INSTEAD: dict[str, str] = {
    "/models/bert-base": "models/bert-base",
    "cuda": "cpu",
}
"""Values of keys that this machine lacks, and those that take their place."""

NOT_RUN: dict[str, str] = {
    "make": "installs, or runs the tests themselves; that its target exists is checked",
    "bash": "runs the tests themselves; that the script exists is checked",
    "hf": "downloads from the network",
    "pip": "installs; the package of examples/extending is laid out on the path instead",
}
"""Programs that no test runs, and why."""

NOT_RUN_PYTHON: dict[tuple[str, str], str] = {
    ("docs/datasets.md", 'backend="ray", address="auto"'): "needs a Ray cluster that runs already",
    ("docs/physics.md", "warp_engine"): "needs the extra gpu and a GPU",
    ("docs/extending.md", '"""A'): "is a module of the package that the page installs; test_extending compares them",
    ("docs/extending.md", '"""Tea'): "likewise",
    ("docs/extending.md", '"""Deep'): "likewise",
}
"""Python blocks that no test runs, by page and a text in them, and why."""

PREPARED: dict[str, tuple[str, ...]] = {
    "benchmarks/paper_tables/README.md": ("data/living_room_shelf",),
    "benchmarks/precision.md": ("data/dimsum_small", "data/dimsum_table"),
    "docs/commands.md": ("data/dimsum_table", "runs/clutter/config.yaml"),
    "docs/datasets.md": ("data/pantry_shelf",),
    "docs/evaluation.md": ("data/dimsum_table",),
    "docs/export.md": ("runs/mine",),
    "docs/grammars.md": ("runs/tea_table",),
    "docs/networks.md": ("data/dimsum_table",),
    "docs/paper.md": ("data/dimsum_table",),
    "docs/priors.md": ("runs/mixed", "FILE.ckpt"),
    "docs/processes.md": ("data/dimsum_table",),
    "docs/prompted_sampling.md": ("data/dimsum_table",),
    "docs/render.md": ("runs/mine", "data/dimsum_table"),
    "docs/search.md": ("runs/mine",),
    "docs/tables.md": ("data/dimsum_table",),
    "docs/user_assets.md": ("my_assets",),
}
"""Folders and files that a page speaks of without making them; each is made just before the block that names it."""

YAML_FILES = {
    "docs/export.md": "values.yaml",
    "docs/extending.md": "my_configs/algorithm/proximal.yaml",
    "docs/user_assets.md": "my_assets/library.yaml",
}
"""Where the YAML block of a page stands, as its text says."""


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
    text = (ROOT / page).read_text(encoding="utf-8")
    return [Block(page, text[: found.start()].count("\n") + 2, found[1], found[2]) for found in _FENCE.finditer(text)]


def commands_of(block: Block) -> list[list[str]]:
    """The words of each command of a shell block, continued lines joined and comments left out."""
    lines = block.code.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def inline_commands(page: str) -> list[list[str]]:
    """The words of each command that stands between backticks in the prose of ``page``."""
    text = _FENCE.sub("", (ROOT / page).read_text(encoding="utf-8"))
    return [shlex.split(found) for found in _INLINE.findall(text)]


def not_run(block: Block) -> str:
    """Why no test runs a Python block; empty for one that runs."""
    return next((why for (page, text), why in NOT_RUN_PYTHON.items() if page == block.page and text in block.code), "")


def smaller(block: Block) -> str:
    """The code of a Python block with smaller numbers, as many lines as in the page."""
    code = block.code
    for old, new in SMALLER.get(block.page, {}).items():
        code = code.replace(old, new)
    return code
