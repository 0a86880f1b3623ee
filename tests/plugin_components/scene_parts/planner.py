"""A planner: best of N under the name of a package."""

from dataclasses import dataclass

from agents.planning import BestOfPlanner, PlannerSettings, register_planner


@register_planner("wide")
@dataclass(frozen=True)
class WideSettings(PlannerSettings):
    """Expands the root alone.

    Attributes:
        batch: scenes at once.
    """

    name: str = "wide"
    batch: int = 2

    def make(self, branching):
        return BestOfPlanner(parallel=self.batch)
