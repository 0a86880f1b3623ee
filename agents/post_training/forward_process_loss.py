"""Base class of the losses of forward-process reinforcement learning, as a torchrl loss.

The losses weight the pretraining loss of finished scenes by how good the scenes were. They need no log-probabilities,
no stored trajectories and no particular sampler.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Generator, Tensor

from agents.networks.text import Text
from agents.post_training.expectation import Expectation
from agents.post_training.own_sample_loss import OwnSampleLoss
from agents.priors.prior import NoisedScenes, ScenePrior
from scene_envs.errors import InvalidInputError


class ForwardProcessLoss(OwnSampleLoss):
    """A loss of finished scenes x_0 at random timesteps of the forward process, weighted by their advantages.

    Every scene is noised once per call. o is the output of the trained denoiser, and o_old that of the sampling policy.
    A subclass defines the loss of an entry, given the advantage of its slot. Squared errors are weighted and reduced as
    in pretraining: a mean over the entries of a scene, then over the valid scenes. Losses of categories are a mean over
    the slots whose category is masked at that timestep, times the prior's ``category_weight``.

    The error of a sample is its target minus the mean target of own samples at that noised scene. ``expectation``
    learns this mean. Without it, o_old replaces the mean, and drifts where all samples are bad.

    ``advantage`` weights the losses of poses, ``category_advantage`` those of categories. Each is one number per scene
    or one per slot. The network denoises every slot given the others, so an advantage per slot credits an object only
    for its own pose.

    Accepted keys (``set_keys``), and those of :class:`~agents.post_training.own_sample_loss.OwnSampleLoss`:
        advantage: (B,), (B, 1) or (B, N) float, for poses. Default ``"advantage"``.
        category_advantage: advantage for categories, of the same shapes, optional; without it categories have no
            credit. Default ``"category_advantage"``.

    Args:
        prior: prior that is trained.
        sampler: prior that sampled the scenes, such as a slower copy of ``prior``; its weights get no gradient.
        expectation: mean of the targets over own samples, trained by ``loss_expectation``; None takes o_old instead.
        generator: source of timesteps, noise and observed entries (CPU); None for torch's own.

    Returns (``forward``): ``loss_objective`` (); ``loss_expectation`` (), the pretraining loss of ``expectation`` on
        the scenes, or 0 without it; and detached ``distance`` (), the root mean square of o - o_old.
    """

    @dataclass
    class _AcceptedKeys(OwnSampleLoss._AcceptedKeys):
        advantage: NestedKey = "advantage"
        category_advantage: NestedKey = "category_advantage"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_objective", "loss_expectation", "distance"]  # noqa: RUF012  (torchrl reads lists)

    def __init__(
        self,
        prior: ScenePrior,
        sampler: ScenePrior,
        *,
        expectation: Expectation | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__(prior, generator=generator)
        self.expectation = expectation
        self._sampler = (sampler,)  # in a tuple: its parameters are not parameters of the loss

    @property
    def sampler(self) -> ScenePrior:
        """The prior that sampled the scenes."""
        return self._sampler[0]

    @property
    def in_keys(self) -> list[NestedKey]:  # type: ignore[override]
        """Keys that must be present."""
        return [*super().in_keys, self.tensor_keys.advantage]

    @abstractmethod
    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """Losses of continuous entries; all arguments broadcast to (B, N, F).

        Args:
            output: output o of the denoiser in training.
            old: output o_old of the sampling policy, a constant.
            target: training target of the denoiser's output for this noise.
            advantage: advantage of each entry's slot.
        """

    @abstractmethod
    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """(B, N) losses of categories.

        Args:
            logits: (B, N, K) logits of the denoiser in training.
            old: (B, N, K) logits of the sampling policy, constants.
            category: (B, N) int64, the clean categories.
            advantage: (B, 1) or (B, N) advantages.
        """

    def of_noised(self, noised: NoisedScenes, flat: TensorDictBase) -> TensorDict:
        """The loss of a batch of shape [B] whose scenes the prior has noised already.

        Raises:
            InvalidInputError: an advantage has neither one value per scene nor one per slot.
        """
        found = super().of_noised(noised, flat)
        found["distance"] = found["distance"].sqrt()
        return found

    def of_scenes(self, noised: NoisedScenes, text: Text | None, flat: TensorDictBase) -> Mapping[str, Tensor]:
        """(B,) losses, (B,) those of the expectation, and (B,) mean squares of o - o_old."""
        scene = flat.get(self.tensor_keys.scene)
        advantage = self._advantage(flat, self.tensor_keys.advantage, scene)
        credit = self._advantage(flat, self.tensor_keys.category_advantage, scene)
        output = self.prior.output(noised, text)
        with torch.no_grad():
            old = self.sampler.output(noised, text)
        features, poses = output.continuous.shape[-1], self.prior.pose_width
        of_entries = advantage[..., None].expand(-1, output.continuous.shape[1], features)
        if features > poses:  # a continuous prior: categories are entries, too
            of_entries = torch.cat(
                [of_entries[..., :poses], credit[..., None].expand(*of_entries.shape[:2], features - poses)], dim=-1
            )
        weight = noised.weight / noised.weight.sum(dim=(1, 2), keepdim=True).clamp(min=1.0)
        target, expectation = noised.target, weight.new_zeros(len(weight))
        if self.expectation is not None:
            expected = self.expectation(noised, text)
            expectation = ((expected - target).square() * weight).sum(dim=(1, 2)) * noised.scale
            target = old.continuous + target - expected.detach()
        entries = self.continuous_loss(output.continuous, old.continuous, target, of_entries)
        losses = (entries * weight).sum(dim=(1, 2)) * noised.scale
        distance = ((output.continuous - old.continuous).detach().square() * weight).sum(dim=(1, 2))
        if output.logits is not None and old.logits is not None and noised.drawn is not None:
            slots = self.category_loss(output.logits, old.logits, noised.category, credit)
            mean = (slots * noised.drawn).sum(dim=1) / noised.drawn.sum(dim=1).clamp(min=1.0)
            losses = losses + self.prior.config.category_weight * mean
        return {"loss_objective": losses, "loss_expectation": expectation, "distance": distance}

    def _advantage(self, flat: TensorDictBase, key: NestedKey, scene: Tensor) -> Tensor:
        """(B, 1) or (B, N); zeros where the key is missing."""
        found = flat.get(key, None)
        if found is None:
            return scene.new_zeros(len(scene), 1)
        found = found.detach().reshape(len(scene), -1)
        if found.shape[1] not in (1, scene.shape[1]):
            raise InvalidInputError(
                f"{key!r} has {found.shape[1]} values per scene; give one, or one per slot ({scene.shape[1]})"
            )
        return found
