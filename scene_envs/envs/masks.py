"""Registry of the masks of the search: which slots of a scene the next inpaintings regenerate."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Annotated, Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.scoring import Score, resolve_reward
from scene_envs.errors import Checked, InvalidInputError, Limit, SceneEnvsError, unknown_name
from scene_envs.registry import Registry, load_plugin
from scene_envs.scene import SceneBatch

MAX_PENETRATION = 1e-3
"""Object pairs that overlap deeper than this (m) count as overlapping, as in feasibility."""


def bad_objects(scene: SceneBatch, score: Score) -> Tensor | None:
    """(N,) bool: free objects that the objective blames, or None when it does not judge single objects. It blames those
    whose flag ``feasible`` is False or, lacking that flag, whose credit per object is not positive.
    """
    if "feasible" in score.object_flags:
        return scene.is_free[0] & ~score.object_flags["feasible"][0]
    if score.per_object is not None:
        return scene.is_free[0] & (score.per_object[0] <= 0)
    return None


def infeasible_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The free objects that physics calls infeasible, under any objective; none when all are feasible. The verdict is
    the flag ``feasible`` of the objective or, lacking it, of the reward ``feasible_objects``, which keeps its verdicts.
    """
    flags = score.object_flags.get("feasible")
    if flags is None:
        flags = resolve_reward("feasible_objects")(scene).object_flags["feasible"]
    return scene.is_free[0] & ~flags[0]


def infeasible_or_empty_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The infeasible objects and all empty slots, as in Pfaff et al. (2025)."""
    return infeasible_mask(scene, score, rng) | scene.is_empty[0]


def blamed_or_empty_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The free objects that the objective blames, and all empty slots. This is :func:`infeasible_or_empty_mask` for a
    count of feasible objects, and :func:`random_mask` where no single object is judged, or none of a full scene blamed.
    """
    bad = bad_objects(scene, score)
    if bad is None or not bool((bad | scene.is_empty[0]).any()):
        return random_mask(scene, score, rng)
    return bad | scene.is_empty[0]


def random_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """A random half of the free objects (rounded up), and all empty slots."""
    free = torch.nonzero(scene.is_free[0]).flatten().cpu().numpy()
    chosen = rng.choice(free, size=(len(free) + 1) // 2, replace=False)
    mask = scene.is_empty[0].clone()
    mask[torch.from_numpy(chosen)] = True
    return mask


_SOME = Limit(lambda number: type(number) is int and number >= 0, "must be a whole number of at least 0")


@dataclass(frozen=True)
class EmptyMask(Checked):
    """Empty slots, and no object: ``count`` of them at random, or all with None."""

    count: Annotated[int, _SOME] | None = None

    place = "mask=empty: "

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
        return _some(scene.is_empty[0], scene.tensor.shape[1] if self.count is None else self.count, rng)


@dataclass(frozen=True)
class OffPromptMask:
    """The objects beyond the numbers in the prompt, both objects of a relation that does not hold, and one empty slot
    for each missing object. Without a ``prompt`` of its own, the mask takes the prompt of the search.
    """

    prompt: str | None = None

    def for_prompt(self, prompt: str | None) -> OffPromptMask:
        """The mask for scenes of ``prompt``; a mask that has a prompt already keeps it."""
        return self if self.prompt is not None else OffPromptMask(prompt)

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
        """(N,) bool, True where a slot is regenerated; none when the scene follows the prompt. Raises InvalidInputError
        where there is no prompt, or it cannot be read.
        """
        from scene_envs.datasets import parse_prompt, scene_facts

        if self.prompt is None:
            raise InvalidInputError("mask=off_prompt has no prompt: give prompt= to the search, or to the mask")
        claims = parse_prompt(self.prompt, scene.scene_type)
        (facts,) = scene_facts(scene)
        mask, missing, named = torch.zeros_like(scene.is_empty[0]), 0, set[int]()
        for check in claims.check(facts):
            free = [slot for slot in check.slots if bool(scene.is_free[0, slot])]
            if hasattr(check.claim, "name"):
                named.update(free)
            if check.holds:
                continue
            relation = not hasattr(check.claim, "number")
            surplus = len(free) if relation else check.found - check.expected
            if surplus > 0:  # objects that the prompt does not name go first
                order = sorted(rng.permutation(free).tolist(), key=lambda slot: slot in named)
                mask[order[:surplus]] = True
            missing += max(0, check.expected - check.found)
        return mask | _some(scene.is_empty[0], missing, rng)


@dataclass(frozen=True)
class CulpritsMask(Checked):
    """A smallest set of objects whose replacement ends all overlaps, and a few empty slots.

    It is enough to replace one object of an overlapping pair, though the objective blames both. Objects with most
    overlaps are masked first, until no two unmasked objects overlap, and so are blamed objects that overlap nothing
    (they fall or slide). Random empty slots are added up to ``at_least``, so that good scenes can grow. With an
    objective that does not judge single objects, ``at_least`` random slots are masked, and a scene without free objects
    is regenerated whole.

    The number of masked slots should be small. At high noise the observed objects are noisy as well, so the masked
    slots get their usual share of objects, regardless of the observed ones. If all empty slots are masked, inpainting
    by clamping therefore adds too many objects and spoils the observed ones.
    """

    at_least: Annotated[int, _SOME] = 4

    @property
    def place(self) -> str:  # type: ignore[override]
        return f"mask={type(self).__name__.removesuffix('Mask').lower()}: "

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
        """(N,) bool, True where a slot is regenerated; ``rng`` breaks ties and draws slots."""
        free, empty = scene.is_free[0], scene.is_empty[0]
        if not bool(free.any()):
            return empty.clone()
        bad = bad_objects(scene, score)
        mask = torch.zeros_like(empty)
        if bad is None:
            return _some(free | empty, self.at_least, rng)
        mask[_culprits(scene, bad, rng)] = True
        for more in (empty, free):
            mask |= _some(more & ~mask, self.at_least - int(mask.sum()), rng)
        return mask


@dataclass(frozen=True)
class BalancedMask(CulpritsMask):
    """The culprits of :class:`CulpritsMask`, and random slots until the shares of objects and of empty slots are equal.

    Such a mask does not depend on the content of slots, like the masks of training, so the number of objects stays the
    same. A mask of all empty slots depends on the content, and the prior then adds too many objects. The share grows
    until ``at_least`` slots are masked, if the scene has as many.
    """

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
        free, empty = scene.is_free[0], scene.is_empty[0]
        mask = CulpritsMask(at_least=0)(scene, score, rng)
        slots, objects = int((free | empty).sum()), int(free.sum())
        share = max(int((mask & free).sum()) / max(objects, 1), min(1.0, self.at_least / max(slots, 1)))
        for kind in (free, empty):
            mask |= _some(kind & ~mask, round(share * int(kind.sum())) - int((mask & kind).sum()), rng)
        return mask


def _culprits(scene: SceneBatch, bad: Tensor, rng: np.random.Generator) -> list[int]:
    """Slots of blamed objects (``bad``, (N,) bool), without those that are feasible once others are removed."""
    from scene_envs.physics import penetration  # loads the physics libraries, which other masks do not need

    blamed = torch.nonzero(bad).flatten().tolist()
    if not blamed:
        return []
    pairs = [pair.slots for pair in penetration(scene).pairs[0] if pair.depth > MAX_PENETRATION]
    overlapping = {slot for pair in pairs for slot in pair}
    welded = set(torch.nonzero(scene.is_welded[0]).flatten().tolist())
    return cover(pairs, welded, rng) + [slot for slot in blamed if slot not in overlapping]


def cover(pairs: Sequence[tuple[int, int]], fixed: Collection[int], rng: np.random.Generator) -> list[int]:
    """Few slots, none of them ``fixed``, that touch every pair: greedy vertex cover, ties broken by ``rng``.

    >>> cover([(1, 2), (2, 3), (2, 4)], (), np.random.default_rng(0))
    [2]
    >>> cover([(0, 1), (0, 2)], {0}, np.random.default_rng(0))
    [1, 2]
    """
    chosen = {slot for pair in pairs for slot in pair if slot not in fixed and not set(pair).isdisjoint(fixed)}
    left = [pair for pair in pairs if chosen.isdisjoint(pair)]
    while left:
        slots, counts = np.unique(left, return_counts=True)
        slot = int(rng.choice(slots[counts == counts.max()]))
        chosen.add(slot)
        left = [pair for pair in left if slot not in pair]
    return sorted(chosen)


def _some(candidates: Tensor, count: int, rng: np.random.Generator) -> Tensor:
    """(N,) bool: ``count`` of the candidates (N,) at random, or as many as there are."""
    slots = torch.nonzero(candidates).flatten().tolist()
    mask = torch.zeros_like(candidates)
    mask[rng.permutation(slots)[: max(0, count)].astype(int).tolist()] = True
    return mask


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
    "infeasible": infeasible_mask,
    "infeasible_or_empty": infeasible_or_empty_mask,
    "off_prompt": OffPromptMask(),
    "random": random_mask,
}
_MASKS: Registry[MaskGenerator] = Registry(
    "mask generator", ENTRY_POINT_GROUP, _SHIPPED, read=lambda point: _checked(point.name, load_plugin(point))
)


def register_mask(name: str) -> Callable[[Generator], Generator]:
    """Make a mask generator available as ``mask=name``; the same name again replaces it. Raises InvalidInputError where
    the name is not one word, or the decorated object cannot be called.

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
    """A mask generator from its name, a mapping of its name and settings, or a function of that form. Raises
    UnknownNameError for an unknown name or setting, and InvalidInputError for anything else.

    >>> resolve_mask({"name": "empty", "count": 2})
    EmptyMask(count=2)
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
    """(N,) bool: the mask that a generator gives for a batch of one; InvalidInputError if it fails or is no mask."""
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
