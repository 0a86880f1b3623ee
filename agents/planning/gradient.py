"""Gradient guidance: the planner that moves scenes along the gradient of a weight during their denoising."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from agents.configuration import build
from agents.planning.ledger import PlanResult, Progress, Searchable, SteeredProblem
from agents.planning.registry import (
    PlannerSettings,
    check_at_least,
    list_planners,
    planner_settings,
    register_planner,
)
from scene_envs.errors import InvalidInputError, unknown_name

if TYPE_CHECKING:
    from torch import Tensor

    from agents.planning.guidance import Guidance
    from scene_envs.scene import SceneBatch

WEIGHTS = ("overlap",)
"""Differentiable log-weights of :mod:`agents.planning.guidance`."""


@register_planner("gradient")
@dataclass(frozen=True)
class GradientPlanner(PlannerSettings):
    """Gradient guidance of every inpainting that another planner makes.

    The distribution of scenes is the prior times exp(strength * weight), to first order around the scene that the
    network expects. The objective scores the finished scenes, and the other planner chooses the next scene to inpaint.
    Guidance adds one gradient of the weight to a step, and no evaluation of the denoiser.

    Attributes:
        planner: name of the other planner, or a mapping of its ``name`` and keys. It must accept any number of
            children of a state, and must not steer the denoising itself.
        weight: a differentiable log-weight: ``overlap``, or in Python a function.
        strength: factor on the weight; 0 is the other planner alone.
        begin: share of the denoising steps that come before guidance.
        children: number of inpaintings per round, one batch of the denoiser; null takes ``branching``.
    """

    name: str = "gradient"
    widens = True
    steers = True
    planner: Any = "greedy"
    weight: Any = "overlap"
    strength: float = 1.0
    begin: float = 0.5
    children: int | None = None

    def __post_init__(self) -> None:
        check_at_least(self, 0, "strength", "begin")
        check_at_least(self, 1, "children")
        if self.begin >= 1:
            raise InvalidInputError(f"planner {self.name}: begin={self.begin} is a share of the steps, below 1")
        if not callable(self.weight) and self.weight not in WEIGHTS:
            raise unknown_name("differentiable weight", str(self.weight), WEIGHTS)
        self._guided()

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(problem, self.name, self._guide)
        return self._guided().make(self.children or 1).plan(steered, budget, progress)

    def _guided(self) -> PlannerSettings:
        keys = {"name": self.planner} if isinstance(self.planner, str) else self.planner
        if not isinstance(keys, Mapping) or not isinstance(keys.get("name"), str):
            raise InvalidInputError(
                f"planner {self.name}: planner={self.planner!r} must be a planner's name, or a mapping of its name and "
                "keys"
            )
        settings = planner_settings(keys["name"])
        if not _is_guidable(settings):
            known = ", ".join(name for name in list_planners() if _is_guidable(planner_settings(name)))
            raise InvalidInputError(
                f"planner {self.name}: planner={self.planner!r} cannot be guided; give one of {known}"
            )
        return build(settings, keys, "planner.planner.")

    def _guide(self, pairs: Sequence[tuple[Any, int]], values: Callable[[SceneBatch], Tensor]) -> Guidance:
        from agents.planning.guidance import Guidance

        weight = self.weight if callable(self.weight) else getattr(guidance, self.weight)
        return Guidance(weight, self.strength, self.begin)


def _is_guidable(settings: type[PlannerSettings]) -> bool:
    return settings.widens and not settings.steers
