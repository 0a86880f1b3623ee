"""Command lines and environments of worker processes, which import what this process would import."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_START = (
    "import sys; sys.path[:] = filter(None, sys.path); del sys.argv[0]; import runpy; "
    "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)"
)
"""Code that runs a module like ``python -m``, but without the current folder as the first place of imports."""


def module_command(module: str, *words: str) -> list[str]:
    """The command line of an interpreter that runs a module, and imports nothing from the current folder.

    >>> module_command("scene_envs.physics.worker", "3")[-2:]
    ['scene_envs.physics.worker', '3']
    """
    return [sys.executable, "-c", _START, module, *words]


def module_environment() -> dict[str, str]:
    """The environment of :func:`module_command`, in which modules are looked for where this process looks."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(entry or os.getcwd() for entry in sys.path)}


@contextmanager
def no_current_folder() -> Iterator[None]:
    """Context in which interpreters started by other code do not import from the current folder (Python >= 3.11)."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before
