"""Configuration of a search run; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from agents.configuration.composition import (
    DeviceKeys,
    EngineKeys,
    PhysicsGuidance,
    PrecisionKeys,
    PromptKeys,
    SamplingKeys,
    composed,
    named,
    nested,
)
from agents.planning.gradient import GradientPlanner
from agents.planning.ledger import PlannerSettings, list_planners, planner_settings
from scene_envs.errors import Count, InvalidInputError, Natural, Unlimited


@dataclass
class BudgetKeys:
    """Budget of a search."""

    budget: int = 64
    max_nfe: int | None = None
    max_seconds: Unlimited | None = None
    count: Count | None = None
    side_by_side: Count = 16
    baseline: bool = True


@composed
@dataclass
class SearchConfig(BudgetKeys, PromptKeys, SamplingKeys, EngineKeys, PrecisionKeys, DeviceKeys):
    """Settings of a search.

    Keys that are not listed are those of :class:`~agents.configuration.composition.PromptKeys`,
    :class:`~agents.configuration.composition.SamplingKeys` and the other bases.

    Attributes:
        budget: number of scenes that each search generates; the baseline generates as many. NFE is ``budget *
            num_steps``, or twice that with guidance.
        max_nfe: largest number of denoiser evaluations of each search; null for no limit other than the budget.
        max_seconds: seconds after which the search ends and returns the best scene found; null for no limit. The
            baseline, which comes after the search, is left out where it would take longer.
        count: number of searches, each with its own seed; each gives one scene. null for one search, or for one from
            each of ``scenes``.
        side_by_side: number of searches that run at once, in common batches of the denoiser; the others follow.
        baseline: whether to draw the same number of independent samples after the search, and compare with the best.
        branching: number of inpaintings per state. The first ``branching`` scenes are fresh samples of the prior, or
            inpaintings of the scene from which the search starts.
        max_depth: largest number of inpaintings in a row, including the fresh sample.
        mask: mask that chooses the slots to regenerate: a registered name, or a mapping of its name and settings; in
            Python also a function.
        masks: several masks, each written as ``mask``; every action uses one of them. null uses ``mask`` alone.
        objective_scale: objective at which Φ is 1; null takes the largest value that the objective declares, or else
            the number of free slots.
        prompt: text that all scenes should match, for priors that read prompts; the objective gets it too. null for no
            prompt.
        physics_guidance: strength, 0 to 1, with which regenerated objects are moved out of overlaps and onto supports
            at the last steps; 0 by default, even for priors that are sampled with physics guidance.
        slots: slots per scene; null takes the number of the scene type.
        seed: seed of the search tree; the baseline starts with the same first scenes, unless the planner steers the
            denoising.
        planner: the planner, which chooses the scenes to inpaint.
    """

    branching: Count = 4
    max_depth: int = 1000
    mask: Any = named("blamed_or_empty", "mask")
    masks: list[Any] | None = None
    objective_scale: float | None = None
    physics_guidance: PhysicsGuidance = 0.0
    workers: Natural = 0
    planner: PlannerSettings = nested(
        GradientPlanner, folder="planner", option="gradient", kinds=planner_settings, registered=list_planners
    )

    @property
    def nfe_per_scene(self) -> int:
        """Denoiser evaluations per generated scene."""
        return self.num_steps * (2 if self.guidance else 1)

    @property
    def expansions(self) -> int:
        """Scenes that each search may generate."""
        return self.budget if self.max_nfe is None else min(self.budget, self.max_nfe // self.nfe_per_scene)

    @property
    def parts(self) -> list[range]:
        """Groups of searches that run at once, as ranges of their numbers."""
        count = self.count or 1
        starts = range(0, count, self.side_by_side)
        return [range(start, min(start + self.side_by_side, count)) for start in starts]

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.budget < self.branching:
            raise InvalidInputError(
                f"budget={self.budget} scenes do not cover the {self.branching} first samples (branching); raise it"
            )
        if self.max_nfe is not None and self.expansions < self.branching:
            raise InvalidInputError(
                f"max_nfe={self.max_nfe} does not cover the {self.branching} first samples (branching) of "
                f"{self.nfe_per_scene} denoiser evaluations each; raise it to {self.branching * self.nfe_per_scene}"
            )
