"""Suppression of the messages that libraries print when they are imported."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

from scene_envs.errors import MissingDependencyError


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Keep the message that PyBullet prints on import out of the user's terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    with open(os.devnull, "w") as sink:
        kept = os.dup(1), os.dup(2)
        try:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            yield
        finally:
            for copy, descriptor in zip(kept, (1, 2), strict=True):
                os.dup2(copy, descriptor)
                os.close(copy)


def quiet_pybullet(otherwise: str) -> Any:
    """The module pybullet; raises MissingDependencyError with the text ``otherwise`` where it is not installed."""
    try:
        with silence():
            import pybullet
    except ImportError as error:
        raise MissingDependencyError(otherwise) from error
    return pybullet
