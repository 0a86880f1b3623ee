"""Outcome of trials, counted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Figures:
    """Outcome of one kind of trial.

    Attributes:
        tried: how many.
        lost: a finished state was gone, or a run could not go on.
        different: a result was not that of an undisturbed run.
        silent: something wrong was told as success, or not in the project's own words.
        notes: the first cases, for whoever looks into them.
        measured: further figures by name.
    """

    tried: int = 0
    lost: int = 0
    different: int = 0
    silent: int = 0
    notes: list[str] = field(default_factory=list)
    measured: dict[str, Any] = field(default_factory=dict)

    def note(self, text: str) -> None:
        """Remember a case, if there are not many yet."""
        if len(self.notes) < 20:
            self.notes.append(text[:600])
