"""Scoring of scenes by a reward, with physics workers, for denoising and search."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import resolve_device
from scene_envs.envs.settings import PROMPT_SOURCES, check_guidance
from scene_envs.errors import WORKERS, InvalidInputError, MissingDependencyError
from scene_envs.protocols import PriorLike, PromptedPriorLike, SceneScorer
from scene_envs.registry import plugin_entry_points
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

ENTRY_POINT_GROUP = "scene_envs.resolvers"
"""Entry points of this group. ``reward = "module:function"`` names a function with the argument of
:func:`resolve_reward` that returns a :class:`~scene_envs.protocols.SceneScorer`. ``prior = "module:function"`` names a
function of a name or path that returns a :class:`~scene_envs.protocols.PriorLike`."""


def resolve_reward(reward: Any) -> SceneScorer:
    """Scorer of ``reward``: a registered name, a mapping with settings, a function or a reward object. Raises
    UnknownNameError for no reward of that name, and MissingDependencyError where no installed package resolves rewards.
    """
    return _resolver("reward")(reward)


def resolve_prior(prior: Any, device: str = "auto") -> PriorLike:
    """A prior from a name or a path, on ``device`` (:func:`~scene_envs.arrays.resolve_device`). One that is given stays
    where it is with ``"auto"``; on another device, a copy is returned. Raises UnknownNameError for no shipped prior of
    that name, and MissingDependencyError where no installed package resolves priors.
    """
    if isinstance(prior, str):
        loaded = _resolver("prior")(prior)
        return loaded.to(resolve_device(device)) if hasattr(loaded, "to") else loaded
    if device == "auto" or not hasattr(prior, "to"):
        return prior  # type: ignore[no-any-return]
    target = torch.empty(0, device=resolve_device(device)).device
    return prior if prior_device(prior) == target else deepcopy(prior).to(target)  # type: ignore[no-any-return]


def prior_device(prior: PriorLike) -> torch.device:
    """Device of the prior's weights; CPU for a prior without weights."""
    parameters: Iterable[Tensor] = prior.parameters() if hasattr(prior, "parameters") else ()
    return next((p.device for p in parameters), torch.device("cpu"))


@cache
def _resolver(kind: str) -> Any:
    points = plugin_entry_points(ENTRY_POINT_GROUP)
    if kind not in points:
        raise MissingDependencyError(
            f"no installed package resolves a {kind}: none has the entry point {kind!r} in the group "
            f"{ENTRY_POINT_GROUP!r}; reinstall SceneEnvs (in a checkout: `pip install -e .`)"
        )
    return points[kind].load()


@dataclass(frozen=True)
class Score:
    """A reward's verdict on B scenes with N slots; every row is finite.

    Attributes:
        value: (B,) float32; 0 where ``valid`` is False.
        valid: (B,) bool.
        terms: Values (B,) float32 by name of the term; 0 where not finite.
        per_object: (B, N) float credit per slot, or None.
        object_flags: Flags (B, N) bool by name.
    """

    value: Tensor
    valid: Tensor
    terms: Mapping[str, Tensor] = field(default_factory=dict)
    per_object: Tensor | None = None
    object_flags: Mapping[str, Tensor] = field(default_factory=dict)

    def row(self, index: int) -> Score:
        """The verdict on one scene, as a batch of one."""
        rows = slice(index, index + 1)
        return Score(
            self.value[rows],
            self.valid[rows],
            {name: term[rows] for name, term in self.terms.items()},
            None if self.per_object is None else self.per_object[rows],
            {name: flag[rows] for name, flag in self.object_flags.items()},
        )


def no_prompts(reward: str) -> str:
    """The message for a ``reward`` that needs prompts, where there are none."""
    return (
        f"{reward} has no prompt to compare with: give prompt= to the command or environment, or "
        "reward='{name: prompt_match, prompt: A scene with 12 objects}'"
    )


class RewardScorer:
    """Scorer of batches of scenes, on their device; its reward, a name, mapping, function or object, is resolved once.
    The ``workers`` for physics start at the first scoring; 0 computes in this process, ``"ray"`` on a Ray cluster.
    ``physics`` names the engine, and ``prompted`` says whether the scenes have prompts. ``depends_on_batch``,
    ``averages_objects`` and ``counts_objects`` are the reward's. An InvalidInputError if the reward needs prompts that
    there are not.

    >>> scorer = RewardScorer("object_count")
    >>> scorer(SceneBatch.empty("dimsum_table", 2)).valid.tolist()
    [True, True]
    """

    def __init__(self, reward: Any, workers: int | str = 0, physics: str = "auto", *, prompted: bool = True) -> None:
        WORKERS.check("", "workers", workers, False)
        self._score = resolve_reward(reward)
        facts = "depends_on_batch", "averages_objects", "counts_objects", "needs_prompts"
        self.depends_on_batch, self.averages_objects, self.counts_objects, needs_prompts = (
            bool(getattr(self._score, fact, False)) for fact in facts
        )
        if needs_prompts and not prompted:
            raise InvalidInputError(
                no_prompts(reward if isinstance(reward, str) else getattr(reward, "name", "the reward"))
            )
        self.workers, self.physics = workers, physics
        self._pool: Any = None

    def __call__(self, batch: SceneBatch, prompts: Sequence[str] | None = None) -> Score:
        """Score ``batch``, made for ``prompts`` if any; rows that cannot be scored come back invalid with value 0."""
        output = self._score(batch, prompts=None if prompts is None else tuple(prompts), pool=self._physics_pool())
        valid = output.is_valid
        value = torch.where(valid, output.value, torch.zeros_like(output.value)).float()
        terms = {name: torch.nan_to_num(term.float(), 0.0, 0.0, 0.0) for name, term in output.terms.items()}
        return Score(value, valid, terms, output.per_object, output.object_flags)

    def maximum(self, slots: int, free_slots: int) -> float | None:
        """The largest value that the reward declares for scenes of this size, None where it declares none."""
        declared = getattr(self._score, "maximum", None)
        return None if declared is None else declared(slots, free_slots)

    def probe(self, empty: SceneBatch, prompts: Sequence[str] | None = None) -> tuple[str, ...]:
        """Names of the terms this reward reports, found by scoring one empty scene in this process."""
        output = self._score(empty, prompts=None if prompts is None else tuple(prompts))
        return tuple(sorted(output.terms))

    def _physics_pool(self) -> Any:
        if self._pool is None and (self.workers != 0 or self.physics != "auto"):
            from scene_envs.physics import make_pool

            self._pool = make_pool(self.workers, physics=self.physics)
        return self._pool

    def close(self) -> None:
        """Stop the worker processes; they start again when needed."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None


_BANK = 64
"""Scenes of a grammar that prompts are drawn from, with three prompts each."""
_MAX_ROWS = 4096
"""Largest number of prompts whose tokens are kept; beyond it, all of them are dropped."""


class EnvPrompts:
    """The prompts of an environment's episodes.

    ``prompt`` is None for none, one prompt, a list to draw from, or ``"grammar"`` (or ``"data"``, the same here) for
    descriptions of the grammar's scenes. ``guidance`` is the weight w of classifier-free guidance in the prior's own
    steps; ``given`` tells whether episodes have prompts. Raises InvalidInputError for prompts that the prior does not
    read or that ask for more objects than ``slots`` per scene, and for guidance without a prompt.

    >>> from scene_envs.envs.scoring import resolve_prior
    >>> prompts = EnvPrompts(resolve_prior("dimsum_table"), ["A scene with two cups.", "A scene."], 0.0, 34)
    >>> prompts.draw(np.random.default_rng(0))
    'A scene.'
    """

    def __init__(self, prior: PriorLike, prompt: Any, guidance: float, slots: int) -> None:
        self._prior, self._slots = prior, slots
        self.guidance = float(guidance)
        self._choices: tuple[str, ...] | None = _choices(prompt)
        self.given = prompt is not None
        self._rows: dict[str, Tensor] = {}  # token indices by prompt; each is read once
        check_guidance("" if self._choices == ("",) else prompt, self.guidance)
        if self.given and not prior.conditional:
            raise InvalidInputError(
                f"prompt={prompt!r}: this prior of {prior.scene_type.name!r} was trained without text; "
                "leave prompt= out, or give a prior that reads prompts"
            )
        if self._choices:
            self.read(self._choices)  # raises if a prompt cannot be followed

    @property
    def reader(self) -> PromptedPriorLike | None:
        """The prior, if it reads prompts."""
        return cast(PromptedPriorLike, self._prior) if self._prior.conditional else None

    @property
    def space(self) -> tuple[int, int] | None:
        """Tokens per prompt, and size of the vocabulary; None when the prior reads no prompts."""
        return None if self.reader is None else self.reader.prompt_space

    def draw(self, rng: np.random.Generator) -> str:
        """The prompt of one episode; ``""`` without prompts. A single prompt uses no random number."""
        if not self.given:
            return ""
        choices = grammar_prompts(self._prior.scene_type, self._slots) if self._choices is None else self._choices
        return choices[0] if len(choices) == 1 else choices[int(rng.integers(len(choices)))]

    def read(self, prompts: Sequence[str]) -> Tensor:
        """Token indices (B, L) int64 of prompts, on the CPU. Raises InvalidInputError where a prompt is too long or
        asks for more objects than there are slots.
        """
        if self.reader is None:
            raise InvalidInputError(f"a prior of {self._prior.scene_type.name!r} without text reads no prompts")
        new = [prompt for prompt in dict.fromkeys(prompts) if prompt not in self._rows]
        if new:
            if len(self._rows) > _MAX_ROWS:
                self._rows.clear()
                new = list(dict.fromkeys(prompts))
            self._rows |= dict(zip(new, self.reader.read_prompts(new, self._slots), strict=True))
        return torch.stack([self._rows[prompt] for prompt in prompts])


def _choices(prompt: Any) -> tuple[str, ...] | None:
    """The prompts to draw from; None for those of a grammar."""
    if prompt is None:
        return ()
    if isinstance(prompt, str):
        return None if prompt in PROMPT_SOURCES else (prompt,)
    if isinstance(prompt, Sequence) and prompt and all(isinstance(text, str) for text in prompt):
        return tuple(prompt)
    raise InvalidInputError(
        f"prompt={prompt!r} must be a text, a list of texts to draw from, one of {', '.join(PROMPT_SOURCES)}, or None"
    )


@lru_cache(maxsize=16)
def grammar_prompts(scene_type: SceneType, slots: int) -> tuple[str, ...]:
    """Descriptions of all kinds of scenes of the type's grammar, the same at every call. Raises InvalidInputError where
    the grammar makes no scene of so few slots.
    """
    from scene_envs.datasets.prompts import describe_all
    from scene_envs.grammars import get_grammar

    batch = get_grammar(scene_type).sample(np.random.default_rng(0), _BANK)
    batch = batch[torch.nonzero(batch.counts <= slots).flatten()]
    if not len(batch):
        raise InvalidInputError(
            f"slots={slots}: none of {_BANK} scenes of the grammar of {scene_type.name!r} has so few objects; "
            "give prompts of your own, or more slots"
        )
    return tuple(prompt for prompts in describe_all(batch, np.random.default_rng(0)) for prompt in prompts)
