"""Names of priors that mention adapters, as ``dimsum_table with runs/a+0.5*runs/b``; imports no torch."""

from __future__ import annotations

import os

_JOINT = " with "


def adapted_name(prior: str, adapter: str) -> str:
    """The name of a prior with adapters; those that it mentions already stay.

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
