"""Reward: likelihood of a scene under a frozen prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import Checked, Count, InvalidInputError
from scene_envs.protocols import LikelihoodPriorLike
from scene_envs.scene import SceneBatch


@register_reward("realism")
@dataclass(frozen=True)
class Realism(Checked):
    """Minus the training loss of a scene under a frozen prior, at fixed timesteps and noise; 0 at most.

    The loss is a bound on the negative log-likelihood up to weights (Ho et al. 2020, Eq. 14). Every scene gets the same
    noise. Its objects are sorted first, so that neither the order of slots nor empty slots matter. A scene whose fixed
    objects are missing is invalid.

    Attributes:
        prior: name or path of the prior; null takes the one with the name of the scene type.
        levels: number of timesteps at which the loss is taken, those of a chain of equally spaced steps.
        seed: seed of the noise.
    """

    name: ClassVar[str] = "realism"
    place = "realism: "
    prior: Any = None
    levels: Count = 8
    seed: int = 0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Evaluate the prior ``levels`` times per scene. No terms and no credit per object.

        Raises:
            UnknownNameError: there is no such prior, or none of the scene type's name.
            InvalidInputError: the prior is of another scene type, or has no training loss.
        """
        prior = _frozen(batch.scene_type.name if self.prior is None else self.prior, str(batch.tensor.device))
        if prior.scene_type.assets != batch.scene_type.assets:
            raise InvalidInputError(
                f"realism: the prior is of scene type {prior.scene_type.name!r}, the scenes are of "
                f"{batch.scene_type.name!r}"
            )
        levels = prior.step_table(self.levels).timesteps
        values = [self._score(prior, batch[row].to("cpu"), levels) for row in range(len(batch))]
        value = torch.tensor(values, device=batch.tensor.device)
        return RewardOutput(value, valid=torch.isfinite(value))

    def _score(self, prior: LikelihoodPriorLike, scene: SceneBatch, levels: Tensor) -> float:
        """Minus the mean loss of one scene; NaN without its fixed objects."""
        order = _canonical_order(scene)
        if order is None:
            return float("nan")
        slots = max(scene.scene_type.slots, len(order))
        sorted_scene = SceneBatch(scene.tensor[:, order], scene.scene_type).with_slots(slots)
        device = prior.initial(1, 1).device
        x0 = prior.encode(sorted_scene.to(device)).expand(len(levels), -1, -1)
        generator = Generator().manual_seed(self.seed)
        with torch.no_grad():
            loss = prior.pretraining_loss(x0, generator, "none", levels.to(device))
        return -float(loss.double().mean())


@lru_cache(maxsize=4)
def _frozen(prior: Any, device: str) -> LikelihoodPriorLike:
    resolved = resolve_prior(prior, device)
    if not isinstance(resolved, LikelihoodPriorLike):
        raise InvalidInputError(
            f"realism: {prior!r} has no encode() and pretraining_loss(); give a prior that has them"
        )
    return resolved


def _canonical_order(scene: SceneBatch) -> NDArray[np.int64] | None:
    """Slots of the objects of one scene: fixed ones as the scene type lists them, then by category and pose."""
    kind, categories = scene.scene_type, scene.categories[0].numpy()
    keys = scene.tensor[0, :, :12].numpy().T[::-1]  # lexsort takes the last key first
    order = np.lexsort((*keys, categories))
    order = order[categories[order] != kind.num_assets]
    first: list[int] = []
    for fixed in kind.fixed:
        found = [slot for slot in order if categories[slot] == kind.assets.index(fixed.asset) and slot not in first]
        if not found:
            return None
        first.append(found[0])
    return np.array([*first, *(slot for slot in order if slot not in first)], dtype=np.int64)
