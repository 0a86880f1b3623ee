"""Gradient guidance: the planner that moves scenes along the gradient of a weight during their denoising."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any

from agents.configuration.composition import build
from agents.planning.ledger import (
    PlannerSettings,
    PlanResult,
    Progress,
    Searchable,
    SteeredProblem,
    list_planners,
    planner_settings,
    register_planner,
)
from scene_envs.arrays import constant_on
from scene_envs.errors import BELOW_ONE, Count, InvalidInputError, at_least, unknown_name

if TYPE_CHECKING:
    from torch import Tensor

    from scene_envs.assets import AssetLibrary
    from scene_envs.scene import SceneBatch

WEIGHTS = ("overlap",)
"""Differentiable log-weights: functions of this module."""


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
    strength: Annotated[float, at_least(0)] = 1.0
    begin: Annotated[float, BELOW_ONE] = 0.5
    children: Count | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not callable(self.weight) and self.weight not in WEIGHTS:
            raise unknown_name("differentiable weight", str(self.weight), WEIGHTS)
        self._guided()

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(
            problem, self.name, Guidance(self.weight if callable(self.weight) else overlap, self.strength, self.begin)
        )
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


def _is_guidable(settings: type[PlannerSettings]) -> bool:
    return settings.widens and not settings.steers


Weight = Callable[["SceneBatch", "Tensor"], "Tensor"]
"""``(batch, translations) -> (B,)``: log-weight of the scenes of ``batch`` with these translations (B, N, 3), m.

Differentiable in ``translations``.
"""


def overlap(batch: SceneBatch, translations: Tensor) -> Tensor:
    """(B,) minus half the sum of squared overlaps of objects, mm². Each object is the upright cylinder around its
    asset; a pair overlaps by the smaller of the overlaps of circles and of heights. Pairs of two welded objects are
    left out, and pairs in which one circle contains the centre of the other.
    """
    import torch

    columns = constant_on(_sizes(batch.scene_type.library), translations.device)
    radius, low, high = columns[batch.categories.clamp(max=batch.scene_type.num_assets)].unbind(-1)
    flat = translations[..., :2]
    away = (flat[:, :, None] - flat[:, None]).square().sum(-1).clamp(min=1e-12).sqrt()
    across = radius[:, :, None] + radius[:, None] - away
    bottom, top = translations[..., 2] + low, translations[..., 2] + high
    along = torch.minimum(top[:, :, None], top[:, None]) - torch.maximum(bottom[:, :, None], bottom[:, None])
    pairs = (
        ~batch.is_empty[:, :, None] & ~batch.is_empty[:, None] & (batch.is_free[:, :, None] | batch.is_free[:, None])
    )
    inside = across.detach() > torch.minimum(radius[:, :, None], radius[:, None])  # on a table, in a bowl
    pairs = pairs.triu(diagonal=1) & ~inside
    depth = torch.minimum(across, along).clamp(min=0.0)
    return -0.5 * (1e3 * torch.where(pairs, depth, torch.zeros_like(depth))).square().sum(dim=(1, 2))


@lru_cache(maxsize=32)
def _sizes(library: AssetLibrary) -> Tensor:
    """(C + 1, 3) radius, lowest and highest point of every asset, m; 0 for the empty slot."""
    import torch

    from scene_envs.scene import hull_corners

    rows = [
        torch.stack([corners[:, :2].norm(dim=-1).amax(), corners[:, 2].amin(), corners[:, 2].amax()]).float()
        for corners in hull_corners(library)
    ]
    return torch.stack([*rows, torch.zeros(3)])


@dataclass(frozen=True)
class Guidance:
    """Gradient of a log-weight, times ``strength``, at the scenes that the network expects; none before ``begin``."""

    weight: Weight
    strength: float
    begin: float  # share of the steps

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor | None:
        """(B, N, 3) m, shift of the denoised translations; None at a step without guidance. Given x_t, x_0 is about
        normal around the denoised scene with standard deviation ``std`` (3,), m, so the weight moves its mean by the
        variance times the gradient of the log-weight, exactly if that is constant. No object moves by more than one
        standard deviation.
        """
        if step < int(self.begin * steps) or not self.strength:
            return None
        import torch

        batch = denoised()
        with torch.enable_grad():
            translations = batch.translations.detach().clone().requires_grad_()
            total = self.weight(batch, translations).sum()
            (gradient,) = torch.autograd.grad(total, translations)
        deviations = std * (self.strength * torch.nan_to_num(gradient)).to(std)
        return std * deviations / deviations.norm(dim=-1, keepdim=True).clamp(min=1.0)
