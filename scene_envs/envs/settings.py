"""Keyword arguments of the environments: names, defaults and checks, shared by all adapters."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene_types import SceneType

ACTION_MODES = ("next_sample", "noise")
PROMPT_SOURCES = ("data", "grammar")
"""Values of ``prompt`` that stand for prompts of scenes; all others are prompts themselves."""

Init = TypeVar("Init", bound=Callable[..., None])


@dataclass(frozen=True, kw_only=True)
class EnvSettings:
    """Settings of every environment.

    Attributes:
        scene: scene type or its name; None means that of the prior, and ``dimsum_table`` without one.
        prior: name, path or prior; None means the shipped prior of the scene type.
        num_steps: denoising steps: of an episode of denoising, of each scene of a search.
        slots: N, slots per scene; None means the scene type's.
        workers: physics worker processes; 0 computes in this process, ``"ray"`` on a Ray cluster.
        prompt: what scenes should hold, for priors that read prompts; None for none.
        guidance: weight of classifier-free guidance in the prior's own steps; needs a prompt.

    Raises:
        InvalidInputError: a number is outside what is accepted.
    """

    scene: str | SceneType | None = None
    prior: Any = None
    num_steps: int = 50
    slots: int | None = None
    workers: int | str = 0
    prompt: Any = None
    guidance: float = 0.0

    def __post_init__(self) -> None:
        self._check_at_least_one("num_steps")

    def _check_at_least_one(self, name: str) -> None:
        number = getattr(self, name)
        if not isinstance(number, int) or number < 1:
            raise InvalidInputError(f"{name}={number!r} must be a whole number of at least 1")


@dataclass(frozen=True, kw_only=True)
class DenoisingSettings(EnvSettings):
    """Settings of the denoising environments.

    Attributes:
        reward: name, mapping, function or reward object.
        action_mode: ``"next_sample"`` or ``"noise"``.
        max_action: actions are clipped to ±max_action.

    Raises:
        InvalidInputError, UnknownNameError: a value is outside what is accepted.
    """

    reward: Any = "object_count"
    action_mode: str = "next_sample"
    max_action: float = 10.0

    def __post_init__(self) -> None:
        if self.action_mode not in ACTION_MODES:
            raise unknown_name("action mode", str(self.action_mode), ACTION_MODES)
        if not (np.isfinite(self.max_action) and self.max_action > 0):
            raise InvalidInputError(f"max_action={self.max_action!r} must be positive and finite")
        super().__post_init__()
        if self.guidance and self.action_mode != "noise":
            raise InvalidInputError(
                f"guidance={self.guidance:g} acts on the prior's own steps, and action_mode={self.action_mode!r} takes "
                "none; use action_mode='noise', or guide the policy"
            )


@dataclass(frozen=True, kw_only=True)
class TreeSettings(EnvSettings):
    """Settings of both search environments.

    Attributes:
        objective: any reward: name, mapping, function or reward object.
        branching: B, inpaintings to choose from.
        max_depth: actions per episode.
        objective_scale: objective at which Φ is 1; None means the largest value that it declares, or else the number
            of free slots.
        max_nfe: denoiser evaluations per episode; None for any number.

    Raises:
        InvalidInputError: a value is outside what is accepted.
    """

    objective: Any = "feasible_objects"
    branching: int = 4
    max_depth: int = 10
    objective_scale: float | None = None
    max_nfe: int | None = None

    def __post_init__(self) -> None:
        self._check_at_least_one("branching")
        self._check_at_least_one("max_depth")
        if self.max_nfe is not None:
            self._check_at_least_one("max_nfe")
        super().__post_init__()
        scale = self.objective_scale
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise InvalidInputError(f"objective_scale={scale!r} must be positive and finite")
        if self.prompt is not None and not isinstance(self.prompt, str):
            raise InvalidInputError(f"prompt={self.prompt!r}: a search follows one text, or None")


@dataclass(frozen=True, kw_only=True)
class SearchSettings(TreeSettings):
    """Settings of the search environment with one mask.

    Attributes:
        mask: name of a mask generator, a mapping with its settings, or a function; see :mod:`scene_envs.envs.masks`.
    """

    mask: Any = "blamed_or_empty"


@dataclass(frozen=True, kw_only=True)
class SearchMaskSettings(TreeSettings):
    """Settings of the search environment with a choice of masks.

    Attributes:
        masks: K of them, each as ``mask`` of :class:`SearchSettings`.

    Raises:
        InvalidInputError: no list, or an empty one.
    """

    masks: Sequence[Any] = ("culprits", "infeasible", "empty", "infeasible_or_empty")

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.masks, str) or not isinstance(self.masks, Sequence) or not self.masks:
            raise InvalidInputError(f"masks={self.masks!r}: give a list of at least one mask, as ['culprits', 'empty']")


def takes(settings: type[EnvSettings]) -> Callable[[Init], Init]:
    """Decorator of an ``__init__`` with ``**settings``: its signature shows the fields of ``settings``."""

    def decorate(init: Init) -> Init:
        own = inspect.signature(init).parameters.values()
        fields = inspect.signature(settings).parameters.values()
        shown = [*(p for p in own if p.kind is not p.VAR_KEYWORD), *fields]
        init.__signature__ = inspect.Signature(shown)  # type: ignore[attr-defined]
        return init

    return decorate
