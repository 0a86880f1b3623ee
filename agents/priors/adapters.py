"""Adapters of priors: updates of the weights of one prior, from a low-rank file or from a fine-tuned prior."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from torch import Tensor

from agents.diffusion import Preconditioning
from agents.networks.low_rank import add_low_rank, low_rank_tensors, merge, set_low_rank
from agents.prior_names import find_prior
from agents.priors.storage import StoredPrior, read_stored
from scene_envs.errors import CorruptFileError, InvalidInputError, SceneEnvsError
from scene_envs.files import write_json
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType
from scene_envs.tensor_files import read_tensors, tensors_digest, write_tensors

ADAPTER_NAME = "adapter.safetensors"
AdapterSpec = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
"""A file, a run folder or a prior; several joined by ``+``, or in a list; each may have a factor before ``*``."""


@dataclass(frozen=True)
class AdapterFacts:
    """Facts about an adapter, from the JSON file beside its tensors.

    Attributes:
        rank: of the updates.
        scale: of the updates.
        prior: name of the prior that it was trained on; empty if that prior had none.
        digest: SHA-256 of that prior's weights.
    """

    rank: int
    scale: float
    prior: str
    digest: str


class Adaptable(Protocol):
    """Interface of a prior that adapters use; :class:`~agents.priors.base.ScenePrior` has it."""

    adapter: AdapterFacts | None
    denoiser: Any
    scene_type: SceneType
    process_name: str
    normalizer: Normalizer
    preconditioning: Preconditioning
    card: dict[str, Any]

    def weights(self) -> dict[str, Tensor]:
        """Trained tensors by name."""

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`."""

    def requires_grad_(self, requires_grad: bool = True) -> Any:
        """Switch the gradient of all weights on or off, as torch modules do."""


Prior = TypeVar("Prior", bound=Adaptable)


@dataclass(frozen=True)
class AdapterTerm:
    """One adapter of a sum.

    Attributes:
        path: its file, a folder that holds it, or a prior with all its weights.
        factor: on its updates.
    """

    path: Path
    factor: float = 1.0

    @property
    def file(self) -> Path:
        """File of the tensors."""
        return self.path / ADAPTER_NAME if self.path.is_dir() else self.path


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


def attach_adapter(prior: Adaptable, name: str, *, rank: int, scale: float, seed: int) -> None:
    """Freeze a prior, and give its network low-rank updates that are trained.

    Args:
        prior: is changed.
        name: name of the prior, which the adapter's file records; empty for a prior that has none.
        rank: of the updates.
        scale: of the updates.
        seed: of the random initial values of the updates.
    """
    prior.adapter = AdapterFacts(rank, scale, name, weights_digest(prior))
    prior.requires_grad_(False)
    add_low_rank(prior.denoiser.network, rank, scale, seed)


def save_adapter(prior: Adaptable, directory: str | os.PathLike[str]) -> Path:
    """Write ``adapter.safetensors`` and ``adapter.json`` of a prior with low-rank updates into ``directory``."""
    assert prior.adapter is not None
    path = write_tensors(Path(directory) / ADAPTER_NAME, low_rank_tensors(prior.denoiser.network))
    write_json(path.with_suffix(".json"), asdict(prior.adapter))
    return path


def with_adapter_of(prior: Prior, directory: str | os.PathLike[str]) -> Prior:
    """A copy of a prior with low-rank updates, which are replaced by those saved in ``directory``."""
    copy = deepcopy(prior)
    set_low_rank(copy.denoiser.network, read_tensors(Path(directory) / ADAPTER_NAME)[0])
    return copy


def merge_adapters(prior: Adaptable, name: str, terms: Sequence[AdapterTerm]) -> None:
    """Add the updates of adapters to the weights of a prior.

    The update of a fine-tuned prior is its weights minus those of ``prior`` (task arithmetic, Ilharco et al. 2023).

    Args:
        prior: is changed.
        name: of the prior, for messages.
        terms: adapters, or fine-tuned priors, that were all trained on this prior.

    Raises:
        InvalidInputError: a file is missing, or an adapter is of another prior.
        CorruptFileError: a file is not an adapter.
    """
    digest = weights_digest(prior)
    read = [(term, _read_whole(term)) for term in terms]
    differences = [_difference(prior, name, term, stored) for term, stored in read if stored is not None]
    low_rank = [(term, _read_facts(term, name, digest), _read_tensors(term)) for term, stored in read if stored is None]
    for term, facts, tensors in low_rank:
        try:
            merge(prior.denoiser.network, tensors, term.factor * facts.scale)
        except (KeyError, RuntimeError) as error:
            raise CorruptFileError(f"the tensors of {str(term.file)!r} do not fit {name!r}: {error}") from error
    if differences:
        weights = prior.weights()
        prior.load_weights({key: value + sum(each[key] for each in differences) for key, value in weights.items()})
    parts = [part for term, stored in read for part in _runs(term, stored)]
    kept = {key: value for key, value in prior.card.items() if key not in ("measures", "limits")}
    prior.card = {**kept, "post_training": {"base": Path(name).name, "sum": parts}}


def _read_whole(term: AdapterTerm) -> StoredPrior | None:
    """The fine-tuned prior that a term names; None if the term has a file of low-rank updates, or is no prior."""
    if term.file.exists():
        return None
    try:
        find_prior(term.path)
    except SceneEnvsError:
        return None
    return read_stored(term.path)


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


def _runs(term: AdapterTerm, stored: StoredPrior | None) -> list[dict[str, Any]]:
    """The runs that made the updates of a term, each with its factor; for a sum, the runs of all its terms."""
    card = stored.card if stored is not None else {}
    run = card.get("post_training") or {"name": (term.path if term.path.is_dir() else term.path.parent).name}
    if "sum" in run:
        return [{**part, "factor": part["factor"] * term.factor} for part in run["sum"]]
    kept = ("name", "algorithm", "reward", "iteration")
    return [{"factor": term.factor, **{key: run[key] for key in kept if key in run}}]


def weights_digest(prior: Adaptable) -> str:
    """SHA-256 of a prior's weights."""
    return tensors_digest({key: tensor.detach().cpu() for key, tensor in prior.weights().items()})


def _read_facts(term: AdapterTerm, name: str, digest: str) -> AdapterFacts:
    """The facts of a low-rank adapter, which must have been trained on prior ``name`` with weights of this digest."""
    file = term.file.with_suffix(".json")
    try:
        facts = AdapterFacts(**json.loads(file.read_text(encoding="utf-8")))
    except (FileNotFoundError, NotADirectoryError):
        raise InvalidInputError(
            f"adapter={str(term.path)!r}: there is no {str(file)!r}; name an adapter.safetensors with its adapter.json "
            "beside it, the folder of a run, or a prior that was trained from this one"
        ) from None
    except (ValueError, TypeError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{str(file)!r} is not the description of an adapter: {error}") from error
    if facts.digest != digest:
        same = "" if facts.prior != name else ", whose weights have changed since"
        named = f"the prior {facts.prior!r}" if facts.prior else "a prior without a name"
        remedy = f"load it with prior={facts.prior}" if facts.prior else "load it with the prior that it was trained on"
        raise InvalidInputError(
            f"the adapter {str(term.path)!r} was trained on {named} (weights {facts.digest[:8]})"
            f"{same}, and not on {name!r} (weights {digest[:8]}); {remedy}, or train one of {name!r}"
        )
    return facts


def _read_tensors(term: AdapterTerm) -> dict[str, Tensor]:
    try:
        return read_tensors(term.file)[0]
    except FileNotFoundError:
        raise InvalidInputError(f"adapter={str(term.path)!r}: there is no {str(term.file)!r}") from None
