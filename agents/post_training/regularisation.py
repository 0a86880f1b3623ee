"""Regularisation of a run: its weights, the factor on them that holds a target, and the KL from the base prior."""

from __future__ import annotations

import logging
import math
from copy import deepcopy
from dataclasses import asdict
from typing import Any

import torch
from torch import Generator

from agents.post_training.base import Algorithm
from agents.post_training.discriminative import DiscriminativeLoss
from agents.post_training.gradients import SceneLoss, add_gradient, add_regularisation_gradient
from agents.post_training.hold import FAR, HIGHEST, HoldState, adjust
from agents.post_training.regularisation_settings import RegularisationSettings
from agents.post_training.rollouts import Rollout
from agents.post_training.scene_bank import PromptedScenes
from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup

logger = logging.getLogger(__name__)


class Regularisation:
    """Terms that keep a prior in training near the base prior, and their weights.

    Args:
        settings: settings of the regularisation.
        prior: the base prior; it is copied if it is needed.
    """

    def __init__(self, settings: RegularisationSettings, prior: ScenePrior) -> None:
        self.settings = settings
        self.target = settings.target
        self.state = HoldState()
        measures = settings.kl_weight > 0 or (self.target is not None and self.target.figure == "kl")
        self.measures_kl = measures
        needed = measures or settings.objective == "discriminative"
        self.base = deepcopy(prior).eval().requires_grad_(False) if needed else None

    @property
    def weight(self) -> float:
        """Coefficient of the pretraining loss on real scenes."""
        return self.settings.pretraining_weight * self.state.factor

    @property
    def kl_weight(self) -> float:
        """Coefficient of the KL divergence."""
        return self.settings.kl_weight * self.state.factor

    def accumulate(self, algorithm: Algorithm[Any], rollout: Rollout, generator: Generator) -> dict[str, float]:
        """Add the gradient of the KL divergence to ``.grad``; returns columns of the log."""
        row = {} if self.target is None else {"regularisation_weight": self.weight, "hold_factor": self.state.factor}
        if self.base is None or not self.measures_kl:
            return row
        parts = algorithm.kl(rollout, self.base, generator)
        value, norm = math.nan, 0.0
        if self.kl_weight:
            value, norm = add_gradient(parts, algorithm.policy.parameters(), self.kl_weight)
        else:
            with torch.no_grad():
                processes = ProcessGroup.current()
                value = processes.sum_numbers(sum(float(term) for part in parts for term in part))[0] / processes.size
        return {**row, "kl": value, "kl_weight": self.kl_weight, "kl_gradient_norm": norm}

    def accumulate_scenes(
        self,
        prior: ScenePrior,
        real: PromptedScenes,
        base: PromptedScenes | None,
        generator: Generator,
        chunk: int | None,
    ) -> dict[str, float]:
        """Add the gradient of the loss on real scenes, and on samples of the base prior; returns columns of the log.

        Real scenes and samples get the same timesteps and noise.

        Args:
            prior: prior in training.
            real: real scenes of all processes.
            base: as many samples of the base prior; None for any loss but the discriminative one.
            generator: source of timesteps and noise (CPU).
            chunk: scenes per pass.
        """

        def add(scenes: PromptedScenes, generator: Generator, loss: SceneLoss | None) -> tuple[float, float]:
            return add_regularisation_gradient(
                prior, scenes.scenes, self.weight, generator, loss=loss, chunk=chunk, prompts=scenes.prompts
            )

        if base is None or self.base is None:
            value, norm = add(real, generator, None)
            return {"pretraining_loss": value, "pretraining_gradient_norm": norm}
        loss = DiscriminativeLoss(prior, self.base, self.settings.sharpness)
        same = Generator().set_state(generator.get_state())
        value, norm = add(real, generator, loss.of_real)
        base_value, base_norm = add(base, same, loss.of_base)
        return {
            "pretraining_loss": value,
            "pretraining_gradient_norm": norm,
            "base_sample_loss": base_value,
            "base_sample_gradient_norm": base_norm,
        }

    def observe(self, figure: str, value: float | None, iteration: int) -> None:
        """Adjust the weights after a measurement of ``figure``; does nothing if the run does not hold this figure."""
        if self.target is None or self.target.figure != figure or value is None:
            return
        held = self.state.lost_at is None
        self.state = adjust(self.state, self.target, value, iteration)
        if held and self.state.lost_at is not None:
            logger.warning("%s", self.verdict())

    def return_to_checkpoint(self, ratio: float) -> None:
        """Keep the weights, and forget how the held figure changed before a return to an earlier checkpoint.

        Args:
            ratio: held-out loss of this checkpoint, as a ratio to the base prior's.
        """
        known = self.target is not None and self.target.figure == "guard"
        self.state = self.state.returned(ratio if known else None)

    def verdict(self) -> str:
        """One sentence that says whether the target was held; empty without a target."""
        state, settings = self.state, self.settings
        if self.target is None or state.measured is None:
            return ""
        if state.lost_at is None and self.target.error(state.measured) > FAR:
            return (
                f"hold={settings.hold} was not held at the end: {self.target.figure} {state.measured:.4g} at the last "
                f"measurement, when the weights of the regularisation were {state.factor:.3g} times the first ones and "
                "still rising; measure more often (guard.every), raise the weights, or lower optimizer.lr"
            )
        if state.lost_at is None:
            return f"hold={settings.hold} was held: {self.target.figure} {state.measured:.4g} at the last measurement."
        return (
            f"hold={settings.hold} could not be held: at iteration {state.lost_at} the weights of the regularisation "
            f"were at their bound, {HIGHEST:g} times the first ones, and {self.target.figure} was still above the "
            f"target ({state.measured:.4g} at the last measurement); lower optimizer.lr, raise the weights, or allow "
            "more"
        )

    def summary(self) -> dict[str, Any] | None:
        """JSON-able, for the metrics; None without a target."""
        if self.target is None:
            return None
        return {
            "target": self.settings.hold,
            "measured": self.state.measured,
            "weight": self.weight,
            "kl_weight": self.kl_weight,
            "not_held_from": self.state.lost_at,
            "verdict": self.verdict(),
        }

    def state_dict(self) -> dict[str, Any]:
        """For a checkpoint."""
        return asdict(self.state)

    def load_state_dict(self, state: dict[str, Any] | None) -> None:
        """Inverse of :meth:`state_dict`; None, for a checkpoint of an earlier version, gives the initial state."""
        self.state = HoldState(**(state or {}))
