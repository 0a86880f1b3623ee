"""``scene-envs priors`` and ``package-prior``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Annotated, ClassVar

from agents.configuration.composition import PhysicsGuidance
from scene_envs.errors import Checked, InvalidInputError, OneOf

WRITES = False


@dataclass
class PriorsConfig:
    """The shipped priors and their figures.

    Attributes:
        prior: prior whose model card is shown: a shipped name, or the folder of a prior or a run; empty lists all
            shipped priors.
    """

    prior: str = ""


def run(settings: PriorsConfig) -> None:
    """Print every shipped prior with its size and its figures, or one card."""
    from agents.configuration.prior_names import find_prior, list_priors
    from agents.priors.card import README
    from agents.priors.files import PriorFacts

    if settings.prior:
        page = find_prior(settings.prior) / README
        print(page.read_text(encoding="utf-8") if page.is_file() else "\n".join(PriorFacts.of(settings.prior).lines()))
        return
    names = list_priors()
    if not names:
        print("no prior ships with this installation; train one with scene-envs pretrain")
    for name in names:
        print("\n".join(PriorFacts.of(name).lines()))


@dataclass
class PackagePriorConfig(Checked):
    """A prior as a folder to publish: configuration, weights in half precision, model card.

    Attributes:
        prior: the folder of a run or of a prior, or a shipped name.
        output: folder of the new prior; its last part is the prior's name, as in agents/priors/shipped/dimsum_table.
        evaluation: metrics.json of scene-envs evaluate, or the folder of that run; empty if the prior was not measured.
        precision: number format of the weights, float16 or float32.
        data: sentence of the card about the training data.
        license: licence of the data, for the card; empty takes that of this package, unless the prior was imported.
        machine: sentence of the card about the machine of the training.
        limits: sentence of the card about the limits of the prior.
        physics_guidance: strength of physics guidance of samples of the new prior where a command gives none, 0 to 1;
            null keeps that of the prior.
    """

    NO_PATHS: ClassVar[Sequence[str]] = ("data",)
    """Keys that are words here, and paths in other commands."""

    prior: str = ""
    output: str = ""
    evaluation: str = ""
    precision: Annotated[str, OneOf(("float16", "float32"))] = "float16"
    data: str = ""
    license: str = ""
    machine: str = ""
    limits: str = ""
    physics_guidance: PhysicsGuidance | None = None


def check_package_prior(settings: PackagePriorConfig) -> None:
    """Refuse impossible settings before the prior is read."""
    if not settings.prior or not settings.output:
        raise InvalidInputError(
            "package-prior: name the prior and its new folder, as in prior=runs/mine output=priors/mine"
        )


def run_package_prior(settings: PackagePriorConfig) -> None:
    """Write the folder. The folder is the prior itself, so no log is written into it."""
    from agents.priors.card import package_prior
    from agents.priors.files import PriorFacts

    keys = {**vars(settings), "evaluation": settings.evaluation or None}
    folder = package_prior(keys.pop("prior"), **keys)
    print("\n".join(PriorFacts.of(folder).lines()))


package_prior = SimpleNamespace(run=run_package_prior, check=check_package_prior, WRITES=False)
