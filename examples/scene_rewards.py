"""Two rewards that a user adds to ``post-train``: one with a frozen prior, and one that depends on the batch.

    scene-envs post-train --allow-local prior=dimsum_table \
        reward='{name: weighted_sum, rewards: [feasible_share, "./examples/scene_rewards.py:Diversity"]}'

``scene-envs check-reward --allow-local reward=./examples/scene_rewards.py:Realism`` tests the contract of one. The
package has neither. As a reward, the likelihood makes scenes lose objects: a likely scene is one with few of them
(benchmarks/post_training.md, "Realism as reward"); there is no figure of a run toward diversity. The reward
``discriminator`` judges how real objects look. Meaningless scenes are diverse as well, so combine ``Diversity`` with a
reward such as ``feasible_share``.

They cost 25 and below 0.5 ms of one core per scene of 20 objects, 100 and 0.61 ms per scene of 60 (``Diversity``: in
batches of eight; all pairs are compared, so with 48 scenes about seven times as much per scene).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator

from agents import ScenePrior
from rewards import RewardContext, RewardOutput
from scene_envs import SceneBatch
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import Checked, Count, InvalidInputError
from scene_envs.scene import SceneObjects, cutoff, matching_distance


@dataclass(frozen=True)
class Realism(Checked):
    """Minus the training loss of a scene under a frozen prior, at fixed timesteps and noise; 0 at most.

    The loss is a bound on the negative log-likelihood up to weights (Ho et al. 2020, Eq. 14). Every scene gets the same
    noise. Its objects are sorted first, so that neither the order of slots nor empty slots matter. A scene whose fixed
    objects are missing is invalid. Values compare scenes under one prior; they do not compare priors. With few levels
    the loss is a noisy measure: it separates disturbed scenes from real ones, but hardly one real scene from another.

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
            InvalidInputError: the prior is of another scene type, or is not a :class:`agents.ScenePrior`.
        """
        prior = frozen(batch.scene_type.name if self.prior is None else self.prior, str(batch.tensor.device))
        if prior.scene_type.assets != batch.scene_type.assets:
            raise InvalidInputError(
                f"realism: the prior is of scene type {prior.scene_type.name!r}, the scenes are of "
                f"{batch.scene_type.name!r}"
            )
        values = [self.score(prior, batch[row].to("cpu")) for row in range(len(batch))]
        value = torch.tensor(values, device=batch.tensor.device)
        return RewardOutput(value, valid=torch.isfinite(value))

    def score(self, prior: ScenePrior, scene: SceneBatch) -> float:
        """Minus the mean loss of one scene; NaN without its fixed objects."""
        order = canonical_order(scene)
        if order is None:
            return float("nan")
        slots = max(scene.scene_type.slots, len(order))
        sorted_scene = SceneBatch(scene.tensor[:, order], scene.scene_type).with_slots(slots)
        levels = prior.step_table(self.levels).timesteps.to(prior.device)
        x0 = prior.encode(sorted_scene.to(prior.device)).expand(len(levels), -1, -1)
        with torch.no_grad():
            loss = prior.pretraining_loss(x0, Generator().manual_seed(self.seed), "none", levels)
        return -float(loss.double().mean())


@lru_cache(maxsize=4)
def frozen(prior: Any, device: str) -> ScenePrior:
    """The prior of a name or path, loaded once per device."""
    resolved = resolve_prior(prior, device)
    if not isinstance(resolved, ScenePrior):
        raise InvalidInputError(f"realism: {prior!r} is not a ScenePrior; give one, or its name or path")
    return resolved


def canonical_order(scene: SceneBatch) -> NDArray[np.int64] | None:
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


@dataclass(frozen=True)
class Diversity:
    """Mean distance of a scene to the other scenes of its batch, from 0 (all are copies) to 1 (nothing in common).

    The distance matches objects of the same asset one to one at the least cost: the distance of the two objects, up to
    a quarter of the longer side of the workspace, which is also the cost of an object without a match
    (:func:`scene_envs.scene.matching_distance`). It is divided by its largest value. A batch of one scene is invalid.
    """

    name: ClassVar[str] = "diversity"
    maximum: ClassVar[float] = 1.0
    depends_on_batch: ClassVar[bool] = True

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Compare all pairs of scenes. Term: ``nearest``, the distance to the nearest other scene, from 0 to 1."""
        count, limit = len(batch), cutoff(batch.scene_type)
        scenes = list(SceneObjects(batch))
        apart = np.zeros((count, count))
        for i in range(count):
            for j in range(i):
                apart[i, j] = apart[j, i] = matching_distance(scenes[i], scenes[j], limit) / limit
        device = batch.tensor.device
        value = torch.from_numpy(apart.sum(axis=1) / max(count - 1, 1)).float().to(device)
        others = apart + np.diag(np.full(count, np.inf))
        nearest = torch.from_numpy(np.where(count > 1, others.min(axis=1, initial=1.0), 0.0)).float().to(device)
        return RewardOutput(value, terms={"nearest": nearest}, valid=torch.full((count,), count > 1, device=device))
