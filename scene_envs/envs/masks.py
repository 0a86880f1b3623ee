"""Registry of the masks of the search: which slots of a scene the next inpaintings regenerate."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.mask_generators import BalancedMask, CulpritsMask, EmptyMask, ExplicitMask, LowestScoringMask, OffPromptMask, RegionMask, blamed_or_empty_mask, infeasible_mask, infeasible_or_empty_mask, penetrating_mask, random_mask, unstable_mask
from scene_envs.envs.scoring import Score
from scene_envs.errors import InvalidInputError, SceneEnvsError, unknown_name
from scene_envs.plugins import load_plugin
from scene_envs.registry import Registry
from scene_envs.scene import SceneBatch

MaskGenerator = Callable[[SceneBatch, Score, np.random.Generator], Tensor]
"""``(scene, score, rng) -> (N,) bool``, True where a slot is regenerated.

``scene`` is a batch of one, ``score`` the objective's verdict on it with its credit and flags per object, and ``rng``
the only source of randomness. Slots of welded objects are taken out of the mask afterwards. A generator that reads the
prompt also has a method ``for_prompt(prompt) -> MaskGenerator``; see :func:`mask_for_prompt`.
"""

ENTRY_POINT_GROUP = "scene_envs.masks"
"""Packages offer mask generators under this group: an entry named after the mask, whose value is a MaskGenerator."""

Generator = TypeVar("Generator", bound=MaskGenerator)

_SHIPPED: dict[str, MaskGenerator] = {
    "balanced": BalancedMask(),
    "blamed_or_empty": blamed_or_empty_mask,
    "culprits": CulpritsMask(),
    "empty": EmptyMask(),
    "explicit": ExplicitMask(),
    "infeasible": infeasible_mask,
    "infeasible_or_empty": infeasible_or_empty_mask,
    "lowest_scoring": LowestScoringMask(),
    "off_prompt": OffPromptMask(),
    "penetrating": penetrating_mask,
    "random": random_mask,
    "region": RegionMask(),
    "unstable": unstable_mask,
}
_MASKS: Registry[MaskGenerator] = Registry(
    "mask generator", ENTRY_POINT_GROUP, _SHIPPED, read=lambda point: _checked(point.name, load_plugin(point))
)


def register_mask(name: str) -> Callable[[Generator], Generator]:
    """Make a mask generator available as ``mask=name``; the same name again replaces it.

    Raises:
        InvalidInputError: the name is not one word, or the decorated object cannot be called.

    >>> @register_mask("doctest_empty")
    ... def empty_slots(scene, score, rng):
    ...     return scene.is_empty[0]
    >>> "doctest_empty" in list_masks()
    True
    """
    _MASKS.check_name(name, "top_shelf")
    return _MASKS.adding(name, lambda generator: _checked(name, generator))


def _checked(name: str, generator: Any) -> Any:
    if not callable(generator):
        raise InvalidInputError(f"mask {name!r}: {generator!r} cannot be called; give (scene, score, rng) -> mask")
    return generator


def list_masks() -> list[str]:
    """Names of all mask generators, those of installed packages included, sorted."""
    return _MASKS.names()


def resolve_mask(mask: Any) -> MaskGenerator:
    """A mask generator from its name, a mapping of its name and settings, or a function of that form.

    Raises:
        UnknownNameError: no mask generator has that name, or it has no such setting; the nearest known is offered.
        InvalidInputError: ``mask`` is none of these.

    >>> resolve_mask({"name": "lowest_scoring", "count": 2})
    LowestScoringMask(count=2)
    """
    if isinstance(mask, str):
        return _MASKS[mask]
    if isinstance(mask, Mapping) and "name" in mask:
        return _with_settings(resolve_mask(str(mask["name"])), {k: v for k, v in mask.items() if k != "name"}, mask)
    if callable(mask):
        return mask  # type: ignore[no-any-return]
    raise InvalidInputError(f"mask={mask!r}: give a name ({', '.join(list_masks())}) or a function")


def mask_for_prompt(generator: MaskGenerator, prompt: str | None) -> MaskGenerator:
    """The generator for scenes of ``prompt``: the result of its ``for_prompt``, or itself without such a method.

    >>> mask_for_prompt(resolve_mask("off_prompt"), "A scene with two cups.")
    OffPromptMask(prompt='A scene with two cups.')
    """
    bind: Callable[[str | None], MaskGenerator] | None = getattr(generator, "for_prompt", None)
    return generator if bind is None else bind(prompt)


def masked_slots(generator: MaskGenerator, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """(N,) bool: the mask that a generator gives for a batch of one.

    Raises:
        InvalidInputError: the generator raised an error, or returned something else.
    """
    name = getattr(generator, "__name__", type(generator).__name__)
    slots = scene.tensor.shape[1]
    try:
        mask = generator(scene, score, rng)
    except SceneEnvsError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise InvalidInputError(
            f"mask {name!r} raised {type(error).__name__}: {error} ({place.filename}, line {place.lineno}); a mask is "
            f"a function (scene, score, rng) that returns a bool tensor of shape ({slots},)"
        ) from error
    if not (isinstance(mask, Tensor) and mask.dtype == torch.bool and mask.shape == (slots,)):
        what = f"{mask.dtype} of shape {tuple(mask.shape)}" if isinstance(mask, Tensor) else type(mask).__name__
        raise InvalidInputError(f"mask {name!r} returned {what}; return a bool tensor of shape ({slots},)")
    return mask


def _with_settings(generator: MaskGenerator, settings: Mapping[str, Any], mask: Mapping[str, Any]) -> MaskGenerator:
    if not settings:
        return generator
    known: list[str] = [field.name for field in fields(generator)] if is_dataclass(generator) else []
    for name in settings:
        if name not in known:
            raise unknown_name(f"setting of mask {mask['name']}", name, known)
    try:
        return replace(generator, **settings)  # type: ignore[type-var]
    except TypeError as error:
        raise InvalidInputError(f"mask={dict(mask)}: {error}") from None
