"""Prompts that are true of a scene, and a parser that reads them back.

Three kinds, after the paper's dataset: how many objects there are, what they are (all kinds or a sample
of kinds), and what stands on top of what.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

_T = TypeVar("_T")

KINDS = ("count", "names", "relations")
"""The kinds of prompts."""

# fmt: off
_WORDS = [
    "no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve", "thirteen",
    "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty",
]
# fmt: on
_SAME_AXIS = 0.02
"""Two frames closer than this (m) in the plane stand on one axis."""
_MAX_RISE = 0.25
"""An object whose frame is at most this far (m) above the next lower one on its axis stands on it."""


@dataclass(frozen=True)
class SceneFacts:
    """What prompts can say about one scene.

    Attributes:
        count: objects, welded ones included.
        objects: display name to number.
        on_top: (upper, lower) display names to the number of such pairs.
    """

    count: int
    objects: Counter[str]
    on_top: Counter[tuple[str, str]]


@dataclass(frozen=True)
class PromptFacts:
    """What one prompt claims; a field is None when it says nothing about it. Fields as in :class:`SceneFacts`."""

    count: int | None = None
    objects: Counter[str] | None = None
    on_top: Counter[tuple[str, str]] | None = None

    def holds(self, scene: SceneFacts) -> bool:
        """Whether every claim is true of ``scene``; numbers are exact for what is named."""
        if self.count is not None and self.count != scene.count:
            return False
        if self.objects is not None and any(scene.objects[name] != n for name, n in self.objects.items()):
            return False
        return self.on_top is None or all(scene.on_top[pair] == n for pair, n in self.on_top.items())


def describe(batch: SceneBatch, rng: np.random.Generator, *, kinds: Sequence[str] = KINDS) -> list[str]:
    """One prompt per scene, of a random kind among those that have something to say.

    Raises:
        InvalidInputError: an unknown kind.
    """
    unknown = sorted(set(kinds) - set(KINDS))
    if unknown or not kinds:
        raise InvalidInputError(f"unknown kinds of prompts {unknown}; choose from {list(KINDS)}")
    nouns = _Nouns(batch.scene_type)
    return [_describe(facts, kinds, nouns, rng) for facts in scene_facts(batch)]


def describe_all(batch: SceneBatch, rng: np.random.Generator, *, count: int = 3) -> list[tuple[str, ...]]:
    """``count`` prompts per scene, of different kinds and without duplicates where the scene has that much to say.

    Raises:
        InvalidInputError: ``count`` is not positive.
    """
    if count < 1:
        raise InvalidInputError(f"count must be at least 1 prompt per scene, got {count}")
    nouns = _Nouns(batch.scene_type)
    return [_describe_all(facts, count, nouns, rng) for facts in scene_facts(batch)]


def parse_prompt(text: str, scene_type: str | SceneType) -> PromptFacts:
    """Read a prompt made by :func:`describe` back into its claims.

    Raises:
        InvalidInputError: the text is not such a prompt.

    >>> parse_prompt("A scene with 12 objects.", "dimsum_table").count
    12
    """
    nouns = _Nouns(get_scene_type(scene_type))
    match = re.fullmatch(r"A scene with (.+)\.", text.strip())
    if match is None:
        raise InvalidInputError(f"cannot read the prompt {text!r}; expected 'A scene with … .'")
    body = match.group(1)
    count = re.fullmatch(r"(\d+) objects?", body)
    if count is not None:
        return PromptFacts(count=int(count.group(1)))
    objects: Counter[str] = Counter()
    on_top: Counter[tuple[str, str]] = Counter()
    for phrase in re.split(r" and |, ", body):
        upper, _, lower = phrase.partition(" on top of ")
        number, name = nouns.read(upper.removesuffix(" each"), text)
        if lower:
            on_top[name, nouns.read(lower, text)[1]] = number
        else:
            objects[name] = number
    return PromptFacts(objects=objects or None, on_top=on_top or None)


def scene_facts(batch: SceneBatch) -> list[SceneFacts]:
    """What can be said about each scene of ``batch``."""
    display = [asset.display_name for asset in batch.scene_type.library]
    categories = batch.categories.numpy()
    translations = batch.translations.double().numpy()
    result = []
    for row, positions in zip(categories, translations, strict=True):
        present = np.flatnonzero(row != len(display))
        names = [display[c] for c in row[present]]
        pairs = Counter(
            (names[up], names[low]) for up, low in _stacked(positions[present], batch.scene_type, row[present])
        )
        result.append(SceneFacts(len(names), Counter(names), pairs))
    return result


def _stacked(positions: np.ndarray, scene_type: SceneType, categories: np.ndarray) -> list[tuple[int, int]]:
    """(upper, lower) indices of free objects that stand on each other, from frame positions (n, 3) m."""
    free = np.flatnonzero(~np.isin(categories, scene_type.welded_categories))
    points = positions[free]
    offsets = points[:, None] - points[None]  # (n, n, 3), upper minus lower
    below = (np.hypot(offsets[..., 0], offsets[..., 1]) < _SAME_AXIS) & (offsets[..., 2] > 1e-3)
    rise = np.where(below & (offsets[..., 2] < _MAX_RISE), offsets[..., 2], np.inf)
    if not len(free):
        return []
    lower = rise.argmin(axis=1)
    return [(int(free[i]), int(free[j])) for i, j in enumerate(lower) if np.isfinite(rise[i, j])]


class _Nouns:
    """Display names, articles and plurals of a scene type."""

    def __init__(self, scene_type: SceneType) -> None:
        self.plural = {asset.display_name: asset.plural for asset in scene_type.library}
        self.article = {asset.display_name: asset.article for asset in scene_type.library}
        self.singular = {plural: name for name, plural in self.plural.items()}

    def say(self, number: int, name: str) -> str:
        if number == 1:
            return f"{self.article[name]} {name}"
        return f"{_WORDS[number] if number < len(_WORDS) else number} {self.plural[name]}"

    def read(self, phrase: str, text: str) -> tuple[int, str]:
        word, _, noun = phrase.partition(" ")
        if word in ("a", "an") and noun in self.plural:
            return 1, noun
        number = int(word) if word.isdigit() else _WORDS.index(word) if word in _WORDS else 0
        if number < 2 or noun not in self.singular:
            raise InvalidInputError(f"cannot read {phrase!r} in the prompt {text!r}")
        return number, self.singular[noun]


def _describe(facts: SceneFacts, kinds: Sequence[str], nouns: _Nouns, rng: np.random.Generator) -> str:
    possible = [kind for kind in kinds if kind != "relations" or facts.on_top] or ["count"]
    kind = possible[int(rng.integers(len(possible)))]
    if kind == "count" or not facts.objects:
        return f"A scene with {facts.count} object{'s' if facts.count != 1 else ''}."
    if kind == "names":
        names = _subset(sorted(facts.objects), rng)
        return f"A scene with {_join([nouns.say(facts.objects[name], name) for name in names])}."
    pairs = _subset(sorted(facts.on_top), rng)
    return f"A scene with {_join([_relation(facts.on_top[pair], pair, nouns) for pair in pairs])}."


def _describe_all(facts: SceneFacts, count: int, nouns: _Nouns, rng: np.random.Generator) -> tuple[str, ...]:
    prompts: list[str] = []
    for turn in range(count):
        for _ in range(10):
            prompt = _describe(facts, [KINDS[turn % len(KINDS)]], nouns, rng)
            if prompt not in prompts:
                break
            prompt = _describe(facts, ["names"], nouns, rng)
            if prompt not in prompts:
                break
        prompts.append(prompt)
    return tuple(prompts)


def _relation(number: int, pair: tuple[str, str], nouns: _Nouns) -> str:
    each = "" if number == 1 else " each"
    return f"{nouns.say(number, pair[0])}{each} on top of {nouns.say(1, pair[1])}"


def _subset(items: list[_T], rng: np.random.Generator) -> list[_T]:
    """All items, or with even chance a random non-empty subset, in random order."""
    size = len(items) if rng.random() < 0.5 else int(rng.integers(1, len(items) + 1))
    return [items[i] for i in rng.permutation(len(items))[:size]]


def _join(phrases: list[str]) -> str:
    if len(phrases) < 3:
        return " and ".join(phrases)
    return f"{', '.join(phrases[:-1])} and {phrases[-1]}"
