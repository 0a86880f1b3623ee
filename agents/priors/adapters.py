"""Adapters of priors: updates of the weights of one prior, which are those of priors that were trained from it."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from agents.diffusion import Preconditioning
from agents.priors.storage import StoredPrior, read_stored
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType

AdapterSpec = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A run folder or a prior; several joined by ``+``, or in a list; each may have a factor before ``*``."""


class Adaptable(Protocol):
    """Interface of a prior that adapters use; :class:`~agents.priors.base.ScenePrior` has it."""

    scene_type: SceneType
    process_name: str
    normalizer: Normalizer
    preconditioning: Preconditioning
    card: dict[str, Any]

    def weights(self) -> dict[str, Tensor]:
        """Trained tensors by name."""

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`."""


@dataclass(frozen=True)
class AdapterTerm:
    """One adapter of a sum.

    Attributes:
        path: path of a prior or of a run, or the name of a shipped prior.
        factor: factor on its updates.
    """

    path: Path
    factor: float = 1.0


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


def merge_adapters(prior: Adaptable, name: str, terms: Sequence[AdapterTerm]) -> None:
    """Add the updates of adapters to the weights of a prior.

    The update of a fine-tuned prior is its weights minus those of ``prior`` (task arithmetic, Ilharco et al. 2023).

    Args:
        prior: prior that is changed.
        name: name of the prior, for messages.
        terms: fine-tuned priors that were all trained from this prior.

    Raises:
        InvalidInputError: nothing is at a path, or an adapter is of another prior.
        CorruptFileError: the files of an adapter are not those of a prior.
    """
    read = [(term, read_stored(term.path)) for term in terms]
    differences = [_difference(prior, name, term, stored) for term, stored in read]
    weights = prior.weights()
    prior.load_weights({key: value + sum(each[key] for each in differences) for key, value in weights.items()})
    parts = [part for term, stored in read for part in _runs(term, stored)]
    kept = {key: value for key, value in prior.card.items() if key not in ("measures", "limits")}
    prior.card = {**kept, "post_training": {"base": Path(name).name, "sum": parts}}


def _difference(prior: Adaptable, name: str, term: AdapterTerm, stored: StoredPrior) -> dict[str, Tensor]:
    """Weights of a fine-tuned prior minus those of its base prior, times the factor of the term."""
    weights, own = prior.weights(), Path(name).name
    base = (stored.card.get("post_training") or {}).get("base", own)
    shapes, others = ({key: tensor.shape for key, tensor in each.items()} for each in (weights, stored.tensors))
    same = (stored.process, stored.scene_type.name, others) == (prior.process_name, prior.scene_type.name, shapes)
    origin = ""
    if base != own:
        origin = f"was trained from {base!r}"
    elif not same:
        origin = "has another network or scene type"
    elif _moments(stored) != _moments(prior):
        origin = "has another normalizer or preconditioning"
    if origin:
        raise InvalidInputError(
            f"adapter={str(term.path)!r}: this prior {origin}, so it cannot be added to {name!r}; give priors that "
            f"were trained from {name!r}, or load its own base prior with prior="
        )
    return {key: term.factor * (stored.tensors[key].to(value) - value) for key, value in weights.items()}


def _moments(prior: Adaptable | StoredPrior) -> tuple[dict[str, Any], dict[str, Any]]:
    """State of the normalizer and of the preconditioning, in whose units the weights read and write poses."""
    return prior.normalizer.state(), prior.preconditioning.state()


def _runs(term: AdapterTerm, stored: StoredPrior) -> list[dict[str, Any]]:
    """The runs that made the updates of a term, each with its factor; for a sum, the runs of all its terms."""
    run = stored.card.get("post_training") or {"name": term.path.name}
    if "sum" in run:
        return [{**part, "factor": part["factor"] * term.factor} for part in run["sum"]]
    kept = ("name", "algorithm", "reward", "iteration")
    return [{"factor": term.factor, **{key: run[key] for key in kept if key in run}}]
