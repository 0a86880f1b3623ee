"""A process that begins as a copy of the test's: what a test kills has not to import everything first."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.context import ForkProcess
from typing import Any


def forked(function: Callable[..., Any], *args: Any) -> ForkProcess:
    """Run ``function(*args)`` in a copy of this process, with nothing of its threads; join or kill it."""
    process = multiprocessing.get_context("fork").Process(target=function, args=args, daemon=True)
    process.start()
    return process
