"""Keyword arguments of the environments: names, defaults and checks, shared by all adapters."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from scene_envs.errors import Checked, InvalidInputError, Limit, OneOf, Positive
from scene_envs.scene_types import SceneType

ACTION_MODES = ("next_sample", "noise")
PROMPT_SOURCES = ("data", "grammar")
"""Values of ``prompt`` that select descriptions of scenes; any other text is a prompt itself."""

_WHOLE = Limit(
    lambda number: type(number) is int and 1 <= number < 2**31, "must be a whole number from 1 to 2,147,483,647"
)
_GUIDANCE = Limit(math.isfinite, "must be a finite number; 0 follows the prompt as it is")
_CLAIM_GUIDANCE = Limit(
    lambda strength: 0 <= strength < math.inf, "must be a finite number of at least 0; 0 guides nothing"
)
_PHYSICS_GUIDANCE = Limit(
    lambda strength: 0 <= strength <= 1,
    "must be a number from 0 to 1; 0 guides nothing, and 1 moves objects until they neither overlap nor float",
)
_SLOTS = Limit(lambda number: type(number) is int and 1 <= number <= 10**5, "must be a whole number from 1 to 100,000")
MASKS = (
    "balanced", "blamed_or_empty", "culprits", "empty", "infeasible", "infeasible_or_empty", "off_prompt", "random",
)  # fmt: skip
"""Names of the mask generators of :mod:`scene_envs.envs.masks`."""


Init = TypeVar("Init", bound=Callable[..., None])


@dataclass(frozen=True, kw_only=True)
class EnvSettings(Checked):
    """Settings of every environment, which the tables of arguments of the environments' classes describe.

    Raises:
        InvalidInputError: a number is outside its range.
    """

    scene: str | SceneType | None = None
    prior: Any = None
    num_steps: Annotated[int, _WHOLE] = 50
    slots: Annotated[int, _SLOTS] | None = None
    workers: int | str = 0
    physics: str = "auto"
    device: str = "auto"
    prompt: Any = None
    guidance: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_guidance(self.prompt, self.guidance)


@dataclass(frozen=True, kw_only=True)
class DenoisingSettings(EnvSettings):
    """Settings of the denoising environments.

    Raises:
        InvalidInputError, UnknownNameError: a value is outside its range.
    """

    reward: Any = "object_count"
    action_mode: Annotated[str, OneOf(ACTION_MODES, "action mode")] = "next_sample"
    max_action: Positive = 10.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.guidance and self.action_mode != "noise":
            raise InvalidInputError(
                f"guidance={self.guidance:g} acts on the prior's own steps, and action_mode={self.action_mode!r} takes "
                "none; use action_mode='noise', or guide the policy"
            )


@dataclass(frozen=True, kw_only=True)
class TreeSettings(EnvSettings):
    """Settings of both search environments.

    Raises:
        InvalidInputError: a value is outside its range.
    """

    objective: Any = "feasible_objects"
    branching: Annotated[int, _WHOLE] = 4
    max_depth: Annotated[int, _WHOLE] = 10
    objective_scale: Positive | None = None
    max_nfe: Annotated[int, _WHOLE] | None = None
    claim_guidance: float = 0.0
    physics_guidance: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_claim_guidance(self.prompt, self.claim_guidance)
        check_physics_guidance(self.physics_guidance)
        if self.prompt is not None and not isinstance(self.prompt, str):
            raise InvalidInputError(f"prompt={self.prompt!r}: a search follows one text, or None")


@dataclass(frozen=True, kw_only=True)
class SearchSettings(TreeSettings):
    """Settings of the search environment with one mask, as :func:`~scene_envs.envs.masks.resolve_mask` takes it."""

    mask: Any = "blamed_or_empty"


@dataclass(frozen=True, kw_only=True)
class SearchMaskSettings(TreeSettings):
    """Settings of the search environment with a choice of masks; InvalidInputError for no list, or an empty one."""

    masks: Sequence[Any] = ("culprits", "infeasible", "empty", "infeasible_or_empty")

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.masks, str) or not isinstance(self.masks, Sequence) or not self.masks:
            raise InvalidInputError(f"masks={self.masks!r}: give a list of at least one mask, as ['culprits', 'empty']")


def check_guidance(prompt: Any, guidance: Any) -> None:
    """Refuse (InvalidInputError) guidance that is no finite number, or has no prompt; ``""`` is none."""
    _GUIDANCE.check("", "guidance", guidance, False)
    if guidance and not prompt:
        raise InvalidInputError(
            f"guidance={guidance:g} strengthens a prompt, and prompt={prompt!r} asks for none; "
            "give prompt=, or leave guidance=0"
        )


def check_claim_guidance(prompt: Any, strength: Any) -> None:
    """Refuse (InvalidInputError) claim guidance that is no number of at least 0, or has no prompt; ``""`` is none."""
    _CLAIM_GUIDANCE.check("", "claim_guidance", strength, False)
    if strength and not prompt:
        raise InvalidInputError(
            f"claim_guidance={strength:g} guides scenes to the claims of a prompt, and prompt={prompt!r} has none; "
            "give prompt=, or leave claim_guidance=0"
        )


def check_physics_guidance(strength: Any, scene_type: SceneType | None = None) -> None:
    """Refuse (InvalidInputError) physics guidance that is no number from 0 to 1, or of assets without geometry."""
    _PHYSICS_GUIDANCE.check("", "physics_guidance", strength, False)
    if strength and scene_type is not None and not scene_type.has_geometry:
        raise InvalidInputError(
            f"physics_guidance={strength:g} needs the geometry of the assets, which scene type {scene_type.name!r} "
            "does not have; leave physics_guidance=0"
        )


def takes(settings: type[Any]) -> Callable[[Init], Init]:
    """Decorator of an ``__init__`` with ``**settings``: its signature shows the fields of ``settings``."""

    def decorate(init: Init) -> Init:
        own = inspect.signature(init).parameters.values()
        fields = inspect.signature(settings).parameters.values()
        shown = [*(p for p in own if p.kind is not p.VAR_KEYWORD), *fields]
        init.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        return init

    return decorate
