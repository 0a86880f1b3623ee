"""Sweeps of ``--multirun``: one list of words for every combination of values.

Hydra's parser reads the values; its sweeper and launcher are not used, because they run only inside ``hydra.main`` and
name their folders by their own rules.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence


def expand_sweeps(words: Sequence[str]) -> list[tuple[list[str], str]]:
    """All combinations of the values of swept words, as Hydra writes them, each with a name for its folder.

    >>> expand_sweeps(["seed=0,1", "reward=object_count"])
    [(['seed=0', 'reward=object_count'], 'seed=0'), (['seed=1', 'reward=object_count'], 'seed=1')]
    """
    choices = [_values(word) for word in words]
    runs = []
    for number, combination in enumerate(itertools.product(*choices)):
        swept = [word for word, options in zip(combination, choices, strict=True) if len(options) > 1]
        label = ",".join(swept)
        plain = all(character.isalnum() or character in "=,._-+" for character in label)
        runs.append((list(combination), label if swept and plain and len(label) < 100 else str(number)))
    return runs


def _values(word: str) -> list[str]:
    """The word, once for every value that it sweeps over."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        parsed = OverridesParser.create().parse_override(word)
    except HydraException:  # a text that is no Hydra value
        return [word]
    if not parsed.is_sweep_override():
        return [word]
    key = word.partition("=")[0]
    return [f"{key}={value}" for value in parsed.sweep_string_iterator()]
