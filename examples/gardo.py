"""GARDO in one file: a penalty on uncertain samples only, and more reward for diverse good ones.

    scene-envs post-train --allow-local algorithm=./examples/gardo.py:gardo reward=feasible_share

He et al. 2025 (arXiv 2512.24138) add three parts to an algorithm; here to NFT, as in one of their implementations.
 - *Gate.* Only the samples that the reward ranks highest above other measures have the penalty |o - o_ref|^2.
 - *Reference.* o_ref takes the weights in training from time to time, so that it holds nothing back for long.
 - *Diversity.* Good samples have their advantage times the distance to the nearest of the same prompt, over its mean.
What the paper leaves open for scenes, and our reading (of its abstract and its code, not of its equations):
 1. The other measure. Theirs are reward models of images. Here it is how probable the base prior finds the sample: its
    pretraining loss of poses and categories, negative, at two noises. The gate is of a whole scene.
 2. Poses have the penalty above, masked categories KL(p_ref || p). Ranks and distances are those of one process.
 3. A scene's features are, for every asset, how many there are and the sum of their positions. The distance is
    1 - cosine, as for images. Credit per object is multiplied by the factor of its scene.
 4. Advantages keep the division by their standard deviation, which the paper leaves out: NFT's clip counts in it.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.post_training import ForwardProcess, NFTLoss, register_algorithm
from agents.post_training.algorithms.base import at_all_steps, final_reward, prompt_groups
from agents.post_training.rollouts import finished_scenes, text_of
from agents.post_training.settings import NFTSettings
from agents.priors.prior import NoisedScenes
from scene_envs.errors import Count, Nonnegative
from scene_envs.scene import POSE_FEATURES, TRANSLATION


@dataclass
class GARDOSettings(NFTSettings):
    """GARDO: NFT with a penalty on uncertain samples, a moving reference and rewarded diversity (He et al. 2025).

    Attributes:
        penalty: coefficient of the distance of uncertain samples to the reference.
        share: largest share of the scenes of a batch that are uncertain.
        period: iterations after which the reference takes the weights in training, again and again.
        diversity: exponent of the relative distance that multiplies positive advantages, 0 for none.
    """

    name: str = "gardo"
    penalty: Nonnegative = 0.5
    share: Nonnegative = 0.1
    period: Count = 15
    diversity: Nonnegative = 1.0


class GARDOLoss(NFTLoss):
    """NFT's loss plus ``gate`` times the distance to the reference."""

    def of_noised(self, noised: NoisedScenes, flat: TensorDictBase) -> TensorDict:
        """The loss of noised scenes; what the reference says of them is kept for the two parts."""
        with torch.no_grad():
            self.said = self.reference.output(noised, self._text(flat))
        self.gate = self.penalty * flat["uncertain"].to(noised.x_t)  # (B, 1)
        return super().of_noised(noised, flat)

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """(B, N, F) losses of the entries of poses."""
        far = (output - self.said.continuous).square()
        return super().continuous_loss(output, old, target, advantage) + self.gate[..., None] * far

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """(B, N) losses of the categories."""
        far = F.kl_div(logits.log_softmax(-1), self.said.logits.log_softmax(-1), reduction="none", log_target=True)
        return super().category_loss(logits, old, category, advantage) + self.gate * far.sum(-1)


@register_algorithm("gardo", GARDOSettings)
class GARDO(ForwardProcess):
    """NFT with the three parts; with ``penalty=0`` and ``diversity=0`` it is NFT, bit for bit."""

    def make_loss(self, settings: Any) -> GARDOLoss:
        """The loss of these settings; its reference is at first the base prior."""
        self.base, self.plain, self.advantage = deepcopy(self.sampler), self.advantage, self.shaped
        loss = GARDOLoss(self.prior, self.sampler, beta=settings.beta, clip=settings.advantage_clip)
        loss.expectation, loss.penalty, loss.reference = self.expectation, settings.penalty, deepcopy(self.sampler)
        return loss

    @torch.no_grad()
    def shaped(self, batch: TensorDictBase) -> TensorDictBase:
        """Write NFT's advantages with the factor of diversity, and ``uncertain`` (B, S, 1) bool."""
        final, scenes, noise = self.plain(batch)[:, -1], finished_scenes(batch), Generator().manual_seed(0)
        x0, (reward, _), prompts = self.prior.encode(scenes), final_reward(final), prompt_groups(final)
        loss = sum(self.base.noised_loss(self.base.noised(x0, noise), text_of(final)) for _ in range(2))
        excess = reward.argsort().argsort() - (-loss).argsort().argsort()
        uncertain = (excess > 0) & ((-excess).argsort().argsort() < self.settings.share * len(excess))
        kinds, entries = scenes.tensor[..., POSE_FEATURES:-1], F.pad(x0[..., TRANSLATION], (0, 1), value=1.0)
        features = F.normalize(torch.einsum("bnk,bnf->bkf", kinds, entries).flatten(1), dim=1)
        near = (1 - features @ features.T).clamp(min=0.0).fill_diagonal_(torch.inf)  # rounding goes below 0
        same = torch.ones_like(near).bool() if prompts is None else prompts[:, None] == prompts
        nearest = near.masked_fill(~same, torch.inf).amin(dim=1)
        far = (nearest * same.sum(dim=1) / torch.where(same, nearest, 0.0).sum(dim=1)).nan_to_num(1.0)[:, None]
        for key in ("advantage", "category_advantage"):
            factor = torch.where(final[key] > 0, far**self.settings.diversity, 1.0)  # 1 for a group of one
            batch[key] = at_all_steps(factor * final[key], batch)
        return batch.set("uncertain", at_all_steps(uncertain, batch))

    def end_iteration(self) -> None:
        """Move the sampler, and renew the reference at the end of its period."""
        super().end_iteration()
        if self.average.updates % self.settings.period == 0:
            self.loss.reference.load_state_dict(self.prior.state_dict())

    def state(self) -> dict[str, Any]:
        """What a resumed run needs."""
        return super().state() | {"reference": self.loss.reference.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        super().restore(state)
        self.loss.reference.load_state_dict(state["reference"])
