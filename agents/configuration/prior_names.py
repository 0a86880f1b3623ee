"""Names and places of priors; imports no torch.

A name may mention adapters, as ``dimsum_table with runs/a+0.5*runs/b``.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scene_envs.errors import InvalidInputError, unknown_name

SHIPPED = Path(__file__).parents[1] / "priors" / "shipped"
"""Folder of the priors that ship with the package."""
CONFIG_NAME = "config.json"
_MAX_NAME = 1000
_JOINT = " with "


def adapted_name(prior: str, adapter: str) -> str:
    """The name of ``prior`` with a further adapter; adapters that ``prior`` already names stay.

    >>> adapted_name("dimsum_table", "runs/a")
    'dimsum_table with runs/a'
    """
    return f"{prior}{'+' if _JOINT in prior else _JOINT}{adapter}"


def split_name(name: str | os.PathLike[str]) -> tuple[str | os.PathLike[str], str]:
    """A prior's own name, and the adapters that the name mentions; empty for none.

    >>> split_name("dimsum_table with runs/a")
    ('dimsum_table', 'runs/a')
    """
    prior, joint, adapter = str(name).partition(_JOINT)
    return (prior, adapter) if joint else (name, "")


def joint_name(name: str | os.PathLike[str], adapters: Sequence[Any]) -> str:
    """The name of a prior together with its adapters; inverse of :func:`split_name`.

    >>> joint_name("dimsum_table", ["runs/a", ["0.5*runs/b"]])
    'dimsum_table with runs/a+0.5*runs/b'
    """
    parts = [str(part) for spec in adapters for part in ([spec] if isinstance(spec, str | os.PathLike) else spec)]
    return _JOINT.join([str(name), "+".join(parts)] if parts else [str(name)])


def short_name(name: str | os.PathLike[str]) -> str:
    """The last part of a prior's path, and its adapters as they are named.

    >>> short_name("runs/first/prior"), short_name("priors/tea with runs/a")
    ('prior', 'tea with runs/a')
    """
    prior, adapter = split_name(name)
    return joint_name(Path(prior).name, [adapter] if adapter else [])


def list_priors() -> list[str]:
    """Names of the priors that ship with the package."""
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{CONFIG_NAME}"))


def find_prior(name: str | os.PathLike[str]) -> Path:
    """The directory of a prior: a shipped name, a prior directory, or a run directory that holds ``prior/``."""
    path = Path(name)
    if len(str(name)) > _MAX_NAME or "\0" in str(name):
        raise InvalidInputError(
            f"prior={str(name)[:60] + '...'!r} is neither a name nor a path ({len(str(name))} characters)"
        )
    for candidate in (SHIPPED / str(name), path, path / "prior"):
        if os.path.isfile(candidate / CONFIG_NAME):
            return candidate
    if os.path.exists(path) or os.sep in str(name):
        raise InvalidInputError(f"{str(name)!r} holds no prior: neither it nor its prior/ folder has a {CONFIG_NAME}")
    raise unknown_name("prior", str(name), list_priors())
