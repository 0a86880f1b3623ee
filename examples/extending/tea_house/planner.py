"""A planner: the best few states of every depth, all their children."""

from dataclasses import dataclass

import numpy as np

from agents.planning import PlannerSettings, PlanResult, register_planner


@register_planner("levels")
@dataclass(frozen=True)
class Beam(PlannerSettings):
    """Beam search.

    Attributes:
        width: states that are kept of every depth.
    """

    name: str = "levels"
    width: int = 2

    def plan(self, problem, budget, progress=None):
        """Spend up to ``budget`` expansions below the current state."""
        root = problem.clone_state()
        beam, values, best = [((), root)], [], (-np.inf, (), root)
        while beam and len(values) < budget:
            pairs = [(path, state, action) for path, state in beam for action in problem.legal_actions(state)]
            pairs = pairs[: budget - len(values)]
            states = problem.expand_batch([(state, action) for _, state, action in pairs])
            children = [
                (float(problem.evaluate(state)) if state.valid else np.nan, (*path, action), state)
                for (path, _, action), state in zip(pairs, states, strict=True)
            ]
            values += [value for value, _, _ in children]
            ranked = sorted((child for child in children if child[0] >= 0), key=lambda child: -child[0])
            best = max([best, *ranked[:1]], key=lambda child: child[0])
            beam = [(path, state) for _, path, state in ranked[: self.width]]
        return PlanResult(best[2], best[0], best[1], values)
