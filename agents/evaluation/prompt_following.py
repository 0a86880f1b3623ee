"""Prompt-following: the share of samples with the numbers, names and relations of their prompts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scene_envs.datasets.prompts import KINDS, PromptFacts, describe, parse_prompt, scene_facts
from scene_envs.datasets.prompts.claims import NameCount, ObjectCount
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

CHANCE_PREFIX = "chance_"
"""Prefix of the figures of real scenes measured against prompts of other real scenes."""

_NAMES = {"count": "prompt_counts", "names": "prompt_names", "relations": "prompt_relations"}


def prompt_following(batch: SceneBatch, prompts: Sequence[str]) -> dict[str, float]:
    """Share of scenes that follow their own prompt.

    This is the paper's prompt-following accuracy. A prompt is followed if every claim in it is true of the scene. The
    numbers of the named objects must be exact. Relations have the tolerances in docs/prompts.md.

    Args:
        batch: B scenes.
        prompts: B prompts that :func:`~scene_envs.datasets.parse_prompt` reads.

    Returns:
        ``prompt_following``: share of all prompts followed. ``prompt_counts``, ``prompt_names`` and
        ``prompt_relations``: the same among prompts of that kind, where there are any. ``prompt_counts_number`` and
        so on: the number of prompts of that kind. ``prompt_score``: mean partial credit in [0, 1], 1 only when every
        prompt is followed.

    Raises:
        InvalidInputError: there is not one prompt per scene, or a prompt cannot be read.

    >>> scenes = SceneBatch.empty("dimsum_table", 2)
    >>> figures = prompt_following(scenes, ["A scene with 1 object.", "A scene with a teapot."])
    >>> figures["prompt_following"], figures["prompt_counts"], figures["prompt_names"]
    (0.5, 1.0, 0.0)
    """
    if len(prompts) != len(batch) or not prompts:
        raise InvalidInputError(f"{len(prompts)} prompts for {len(batch)} scenes; give one prompt per scene")
    asked = [parse_prompt(prompt, batch.scene_type) for prompt in prompts]
    followed: dict[str, list[bool]] = {kind: [] for kind in KINDS}
    scores = []
    for prompt, scene in zip(asked, scene_facts(batch), strict=True):
        checks = prompt.check(scene)
        followed[kind_of(prompt)].append(all(check.holds for check in checks))
        scores.append(np.mean([check.score for check in checks]))
    figures = {"prompt_following": float(np.mean([holds for kind in followed.values() for holds in kind]))}
    for kind, holds in followed.items():
        if holds:
            figures |= {_NAMES[kind]: float(np.mean(holds)), f"{_NAMES[kind]}_number": float(len(holds))}
    return {**figures, "prompt_score": float(np.mean(scores))}


def prompt_chance(batch: SceneBatch, prompts: Sequence[str], seed: int = 0) -> dict[str, float]:
    """Score by chance, in which each scene is checked against the prompt of another.

    Args:
        batch: B >= 2 real scenes.
        prompts: B prompts of these scenes.
        seed: seed of the permutation of the prompts.

    Returns:
        The shares of :func:`prompt_following` under ``chance_<name>``.

    Raises:
        InvalidInputError: there are fewer than two scenes.
    """
    if len(batch) < 2:
        raise InvalidInputError(f"chance needs at least 2 scenes to exchange prompts, got {len(batch)}")
    order = np.random.default_rng(seed).permutation(len(prompts))
    others = np.empty_like(order)
    others[order] = np.roll(order, 1)  # one cycle: no scene keeps its own prompt
    figures = prompt_following(batch, [prompts[i] for i in others])
    return {CHANCE_PREFIX + name: value for name, value in figures.items() if not name.endswith("_number")}


def own_prompts(batch: SceneBatch, seed: int = 0) -> list[str]:
    """One prompt per scene that is true of it; counts, names and relations take turns.

    A scene that has no relations to describe gets a prompt on its number of objects.

    >>> own_prompts(SceneBatch.empty("dimsum_table", 1))
    ['A scene with 1 object.']
    """
    rng = np.random.default_rng(seed)
    prompts = [""] * len(batch)
    for turn, kind in enumerate(KINDS):
        rows = list(range(turn, len(batch), len(KINDS)))
        if rows:
            for row, prompt in zip(rows, describe(batch[rows], rng, kinds=[kind]), strict=True):
                prompts[row] = prompt
    return prompts


def kind_of(prompt: PromptFacts) -> str:
    """Kind of a prompt, one of :data:`~scene_envs.datasets.prompts.KINDS`."""
    first = prompt.claims[0]
    return "count" if isinstance(first, ObjectCount) else "names" if isinstance(first, NameCount) else "relations"
