"""The commands of ``scene-envs``, imported when they are called: one module for each subject.

A command module has ``run(settings, run)``, which does the work. The annotation of ``settings`` is a dataclass; its
fields are the keys of the command, each with a sentence under ``Attributes:``. A module with ``WRITES = False`` has no
run folder.
"""

from importlib import import_module
from typing import Any

COMMANDS = {
    "generate": "make a dataset of scenes from a grammar",
    "pretrain": "train a prior on a dataset",
    "post-train": "steer a prior with a reward (reinforcement learning with regularisation on real scenes)",
    "doctor": "examine a post-training run before it starts",
    "sample": "draw scenes and pictures from a prior",
    "complete": "fill the empty slots of scenes and keep their objects",
    "rearrange": "give the objects of scenes new poses",
    "search": "search for scenes that score high, at inference time",
    "project": "make scenes simulation-ready: project out of penetration, then settle",
    "export": "write scenes for simulators and viewers: URDF, SDF, Drake, MJCF, USD, GLB, arrays",
    "render": "write images of cameras in scenes: color, depth, masks, normals, and annotations as those of COCO",
    "verify": "judge exported scenes in every engine and simulator that is installed",
    "view": "write a page that shows scenes in a browser: a dataset, samples, a prior or a grammar",
    "evaluate": "measure the samples of a prior against real scenes",
    "priors": "list the shipped priors",
    "package-prior": "write a prior as a folder to publish, in half precision and with a model card",
    "rewards": "list the rewards, also those of installed packages",
    "import-checkpoint": "make a prior from a checkpoint of the paper's authors",
    "check-reward": "check that a reward keeps its contract",
    "demo": "steer the shipped prior two ways, compare the results, write a report",
}
"""Summaries of the commands, in the order of the listing."""

_TOGETHER = {
    "complete": "inpaint",
    "rearrange": "inpaint",
    "project": "export",
    "verify": "export",
    "pretrain": "training",
    "post-train": "training",
    "doctor": "training",
    "check-reward": "rewards",
    "package-prior": "priors",
}
"""Commands that are objects of a common module."""


def load_command(name: str) -> Any:
    """The module of a command, or the object with the same functions in a common module."""
    word = name.replace("-", "_")
    module = import_module(f"agents.cli.commands.{_TOGETHER.get(name, word)}")
    return getattr(module, word) if name in _TOGETHER else module
