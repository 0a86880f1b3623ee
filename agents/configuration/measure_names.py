"""Names of the groups of measures; imports no torch."""

from __future__ import annotations

from collections.abc import Iterable

from scene_envs.errors import InvalidInputError, unknown_name

MEASURE_NAMES = ("layout", "physics", "ready", "fsd", "novelty", "prompts", "classifier", "renders", "fid")
"""Groups of measures, in the order in which they are computed: cheap ones first."""


def choose_measures(measures: str | Iterable[str], *, project: bool = True) -> list[str]:
    """Names of groups, in their order.

    Args:
        measures: ``"all"``, a name, names joined by commas, or a list of names.
        project: whether ``"all"`` includes ``ready``.

    Raises:
        UnknownNameError: a name that is no group.
        InvalidInputError: no name, or something else than names.

    >>> choose_measures("novelty, layout")
    ['layout', 'novelty']
    """
    if not isinstance(measures, str | Iterable):
        raise InvalidInputError(f"measures={measures!r} is no list of names; known: all, {', '.join(MEASURE_NAMES)}")
    names = [name.strip() for name in measures.split(",")] if isinstance(measures, str) else [*map(str, measures)]
    if "all" in names and all(name == "all" or name in MEASURE_NAMES for name in names):
        return [name for name in MEASURE_NAMES if project or name != "ready"]
    if not names:
        raise InvalidInputError(f"measures is empty; give all, or some of {', '.join(MEASURE_NAMES)}")
    for name in names:
        if name not in MEASURE_NAMES:
            raise unknown_name("measure", name, ["all", *MEASURE_NAMES])
    return [name for name in MEASURE_NAMES if name in names]
