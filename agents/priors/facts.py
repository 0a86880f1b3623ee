"""Facts about a prior from its files, and its lines in a listing."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from agents.prior_names import find_prior
from agents.priors.files import WEIGHTS_NAME, count_parameters, read_config
from scene_envs.errors import CorruptFileError

HEADLINES = {
    "feasible_fraction": "free objects feasible as sampled",
    "ready_fraction": "after projection and settling",
    "classifier_accuracy": "told from real scenes by a classifier",
    "prompt_following": "prompts followed",
    "novelty": "novelty",
}
"""The figures of :mod:`agents.evaluation` that a listing shows, and their labels."""
_RATIOS = ("novelty",)
_FLOOR = "floor_"


@dataclass(frozen=True)
class PriorFacts:
    """Facts about a prior from its files.

    Attributes:
        name: as it was asked for.
        scene_type: its scene type.
        process: ``"continuous"`` or ``"mixed"``.
        slots: slots per scene that it was trained on.
        text: description of its text encoder; empty for a prior without text.
        parameters: number of trained parameters in its file.
        megabytes: size of its weights on disk, MB.
        card: facts about its training and, under ``measures``, its figures.
    """

    name: str
    scene_type: str
    process: str
    slots: int
    text: str
    parameters: int
    megabytes: float
    card: Mapping[str, Any]

    @classmethod
    def of(cls, name: str | os.PathLike[str]) -> PriorFacts:
        """The facts of a shipped prior, or of one in a prior or run directory; weights are not read.

        Raises:
            UnknownNameError, InvalidInputError, CorruptFileError: as :func:`agents.priors.files.read_prior`.
        """
        folder, state = find_prior(name), read_config(name)
        try:
            made = state["prior"]
            return cls(
                name=str(name),
                scene_type=made["scene_type"],
                process=state.get("process", "continuous"),
                slots=made["slots"],
                text=_reader(made.get("text")),
                parameters=count_parameters(name),
                megabytes=(folder / WEIGHTS_NAME).stat().st_size / 1e6,
                card=state.get("card") or {},
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise CorruptFileError(
                f"the configuration of the prior {str(name)!r} is not one of ours: {error}"
            ) from error

    @property
    def measures(self) -> dict[str, float]:
        """The figures of its samples; empty when it was never measured."""
        return dict(self.card.get("measures") or {})

    def lines(self) -> list[str]:
        """A few lines for a listing."""
        prompts = f"reads prompts with {self.text}" if self.text else "reads no prompts"
        head = f"{self.name}: scenes of {self.scene_type}, {self.slots} slots, {self.process} process, {prompts}"
        rows = [f"{self.parameters / 1e6:.1f} M parameters, {self.megabytes:.1f} MB"]
        shown = headlines(self.measures)
        width = max((len(label) for label, _, _ in shown), default=0)
        rows += [
            f"{label:{width}}  {value:>6}{f'  (real scenes {real})' if real else ''}" for label, value, real in shown
        ]
        return [head, *(f"    {row}" for row in (rows if shown else [*rows, "not measured"]))]


def headlines(measures: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """(label, samples, real scenes) of the figures that a listing shows; figures that were not measured are left out.

    >>> headlines({"feasible_fraction": 0.81, "floor_feasible_fraction": 0.99, "novelty": 0.954})
    [('free objects feasible as sampled', '81 %', '99 %'), ('novelty', '0.95', '')]
    """
    rows = []
    for name, label in HEADLINES.items():
        if name in measures:
            rows.append((label, _figure(name, measures[name]), _figure(name, measures.get(_FLOOR + name))))
    return rows


def _reader(text: Mapping[str, Any] | None) -> str:
    if text is None:
        return ""
    if text.get("kind") == "bert":
        return f"BERT ({os.path.basename(text['model'])})"
    return f"a vocabulary of {len(text['words'])} words"


def _figure(name: str, value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.2f}" if name in _RATIOS else f"{100 * value:.3g} %"
