"""Adapters of priors: updates of the weights of one prior, which are those of priors that were trained from it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from agents.priors.files import StoredPrior, read_stored
from scene_envs.errors import InvalidInputError

AdapterSpec = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A run folder or a prior; several joined by ``+``, or in a list; each may have a factor before ``*``."""


@dataclass(frozen=True)
class AdapterTerm:
    """One adapter of a sum."""

    path: Path  # of a prior or of a run, or the name of a shipped prior
    factor: float = 1.0  # on its updates


def parse_adapters(spec: AdapterSpec) -> list[AdapterTerm]:
    """The adapters that a user named; a path that exists is one adapter, whatever characters it has.

    >>> parse_adapters("runs/a+0.5*runs/b")
    [AdapterTerm(path=PosixPath('runs/a'), factor=1.0), AdapterTerm(path=PosixPath('runs/b'), factor=0.5)]
    """
    if not isinstance(spec, str | os.PathLike):
        return [term for each in spec for term in parse_adapters(each)]
    if Path(spec).exists():
        return [AdapterTerm(Path(spec))]
    terms = []
    for part in str(spec).split("+"):
        factor, _, path = part.rpartition("*")
        if not path or (factor and not re.fullmatch(r"-?\d+(\.\d*)?", factor.strip())):
            raise InvalidInputError(f"adapter={str(spec)!r}: write PATH or FACTOR*PATH in place of {part!r}")
        terms.append(AdapterTerm(Path(path.strip()), float(factor or 1)))
    return terms


def merge_adapters(base: StoredPrior, name: str, terms: Sequence[AdapterTerm]) -> StoredPrior:
    """The prior ``base``, called ``name``, with the updates of ``terms`` added to its weights, which are fine-tuned
    priors that were all trained from it. The update of a fine-tuned prior is its weights minus those of ``base`` (task
    arithmetic, Ilharco et al. 2023). An InvalidInputError if nothing is at a path, or an adapter is of another prior; a
    CorruptFileError if the files of an adapter are not those of a prior.
    """
    read = [(term, read_stored(term.path)) for term in terms]
    differences = [_difference(base, name, term, stored) for term, stored in read]
    tensors = {key: value + sum(each[key] for each in differences) for key, value in base.tensors.items()}
    kept = {key: value for key, value in base.card.items() if key not in ("measures", "limits")}
    parts = [part for term, stored in read for part in _runs(term, stored)]
    card = {**kept, "post_training": {"base": Path(name).name, "sum": parts}}
    return replace(base, tensors=tensors, card=card)


def _difference(base: StoredPrior, name: str, term: AdapterTerm, stored: StoredPrior) -> dict[str, Tensor]:
    """Weights of a fine-tuned prior minus those of its base prior, times the factor of the term."""
    own = Path(name).name
    trained_from = (stored.card.get("post_training") or {}).get("base", own)
    first, second = (
        (each.process, each.scene_type.name, {key: tensor.shape for key, tensor in each.tensors.items()})
        for each in (stored, base)
    )
    units, base_units = ((each.normalizer.state(), each.preconditioning.state()) for each in (stored, base))
    origin = ""
    if trained_from != own:
        origin = f"was trained from {trained_from!r}"
    elif first != second:
        origin = "has another network or scene type"
    elif units != base_units:
        origin = "has another normalizer or preconditioning"
    if origin:
        raise InvalidInputError(
            f"adapter={str(term.path)!r}: this prior {origin}, so it cannot be added to {name!r}; give priors that "
            f"were trained from {name!r}, or load its own base prior with prior="
        )
    return {key: term.factor * (stored.tensors[key] - value) for key, value in base.tensors.items()}


def _runs(term: AdapterTerm, stored: StoredPrior) -> list[dict[str, Any]]:
    """The runs that made the updates of a term, each with its factor; for a sum, the runs of all its terms."""
    run = stored.card.get("post_training") or {"name": term.path.name}
    if "sum" in run:
        return [{**part, "factor": part["factor"] * term.factor} for part in run["sum"]]
    kept = ("name", "algorithm", "reward", "iteration")
    return [{"factor": term.factor, **{key: run[key] for key in kept if key in run}}]
