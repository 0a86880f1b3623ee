"""Guidance of a reverse chain by the claims of prompts and by physics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor

from agents.diffusion.step_tables import StepTable
from agents.priors.claim_guidance import ClaimGuidance
from agents.priors.hooks import Estimating, Guide, Hook, Watch, make_hook
from agents.priors.number_guidance import NumberGuidance
from agents.priors.physics_guidance import PhysicsGuidance
from scene_envs.envs.settings import check_physics_guidance
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType


def physics_strength(given: float | None, config: Any, scene_type: SceneType) -> float:
    """Strength of physics guidance of a chain.

    Args:
        given: by the caller; None takes that of the prior.
        config: of the prior.
        scene_type: of the scenes.

    Raises:
        InvalidInputError: not from 0 to 1, or the assets have no geometry.
    """
    strength = config.physics_guidance if given is None else given
    check_physics_guidance(strength, scene_type)
    return float(strength)


def guidance_hook(
    prior: Estimating,
    scene_type: SceneType,
    table: StepTable,
    scenes: Callable[[Tensor], SceneBatch],
    moved: Tensor,
    *,
    prompts: Sequence[str] | None = None,
    claim_guidance: float = 0.0,
    physics_guidance: float = 0.0,
    guide: Guide | None = None,
    watch: Watch | None = None,
) -> Hook | None:
    """The hook of one chain under guidance; None if nothing watches or guides it.

    Args:
        prior: that denoises.
        scene_type: of the scenes.
        table: the chain.
        scenes: the B scenes of normalised x_0 (B, N, D), as watch and guides see them.
        moved: (B, N, 1) bool, slots whose poses are denoised.
        prompts: one per scene; without prompts there is no claim guidance.
        claim_guidance: strength, 0 for none.
        physics_guidance: strength, 0 for none.
        guide: called before the other guides.
        watch: called at the end of each step.
    """
    movable = moved.squeeze(-1)
    guides: list[Guide] = [] if guide is None else [guide]
    numbers = None
    if prompts is not None and claim_guidance:
        guides.append(ClaimGuidance(prompts, scene_type, claim_guidance, movable))
        numbers = NumberGuidance(prompts, scene_type)
    if physics_guidance:
        guides.append(PhysicsGuidance(physics_guidance, movable))
    return make_hook(prior, table, scenes, moved, watch=watch, guides=guides, draw=numbers)
