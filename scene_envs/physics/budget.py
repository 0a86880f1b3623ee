"""Work budget: a count of solver work that stops searches at the same step on every machine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Budget:
    """Units of work that a search may spend; one unit is one pair of convex parts looked at.

    Attributes:
        limit: units until the search ends.
        spent: units spent so far.
    """

    limit: float
    spent: float = 0.0

    def spend(self, units: float) -> None:
        """Add ``units`` of work."""
        self.spent += units

    @property
    def is_spent(self) -> bool:
        """Whether the limit is reached."""
        return self.spent >= self.limit
