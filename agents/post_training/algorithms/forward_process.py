"""Forward-process algorithms NFT and AWM: losses, mean of own samples, and gradient of a batch."""

from __future__ import annotations

from abc import abstractmethod
from copy import deepcopy
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from agents.networks.text import Text
from agents.post_training.algorithms.base import (
    AveragedSampler,
    BatchGradient,
    ForwardAdvantage,
    PlainLoss,
    accepted_keys,
    in_parts,
)
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import finished_scenes
from agents.post_training.settings import ForwardProcessSettings, NFTSettings
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.utils.process_group import ProcessGroup, gather_rows
from scene_envs.errors import InvalidInputError


class ForwardProcessLoss(PlainLoss):
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

    Accepted keys (``set_keys`` renames them):
        scene: (B, N, D) float, finished scenes x_0 as the prior encodes them.
        timestep: (B,) or (B, 1) int64, optional; without it, drawn as in pretraining.
        valid: (B,) or (B, 1) bool, optional; False rows are left out of the mean.
        text, text_mask: (B, L, W) tokens and (B, L) their mask, optional.
        advantage: (B,), (B, 1) or (B, N) float, for poses.
        category_advantage: advantage for categories, of the same shapes, optional; without it categories have no
            credit.

    Args:
        prior: prior that is trained.
        sampler: prior that sampled the scenes, such as a slower copy of ``prior``; its weights get no gradient.
        beta: strength, of the meaning that the subclass gives it; None for its default.
        clip: c, the advantage at which a sample is fully good or bad.
        expectation: mean of the targets over own samples, trained by ``loss_expectation``; None takes o_old instead.
        generator: source of timesteps, noise and observed entries (CPU); None for torch's own.

    Returns (``forward``): ``loss_objective`` (); ``loss_expectation`` (), the pretraining loss of ``expectation`` on
        the scenes, or 0 without it; and detached ``distance`` (), the root mean square of o - o_old.
    """

    default_keys = _AcceptedKeys = accepted_keys("scene", "timestep", "valid", "advantage", "category_advantage")
    required = ("scene", "advantage")
    out_keys = ["loss_objective", "loss_expectation", "distance"]  # noqa: RUF012  (torchrl reads lists)
    prior: ScenePrior
    default_beta: ClassVar[float]
    least_beta: ClassVar[float] = 0.0
    """Number that beta must exceed."""

    def __init__(
        self,
        prior: ScenePrior,
        sampler: ScenePrior,
        *,
        beta: float | None = None,
        clip: float = 1.0,
        expectation: Expectation | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__()
        self.beta, self.clip = self.default_beta if beta is None else beta, clip
        if not self.beta > self.least_beta:
            why = ": below, a bad sample pushes without bound" if self.least_beta else ""
            raise InvalidInputError(f"beta={self.beta} must be above {self.least_beta:g}{why}")
        if not clip > 0:
            raise InvalidInputError(f"clip={clip} must be positive")
        self.prior, self.generator = prior, generator
        self.expectation = expectation
        self._sampler = (sampler,)  # in a tuple: its parameters are not parameters of the loss

    @property
    def sampler(self) -> ScenePrior:
        """The prior that sampled the scenes."""
        return self._sampler[0]

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

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of finished scenes."""
        flat = tensordict.reshape(-1)
        timestep = flat.get(self.tensor_keys.timestep, None)
        scene = flat.get(self.tensor_keys.scene).detach()
        t = None if timestep is None else timestep.reshape(-1)
        return self.of_noised(self.prior.noised(scene, self.generator, t), flat)

    def of_noised(self, noised: NoisedScenes, flat: TensorDictBase) -> TensorDict:
        """The loss of a batch of shape [B] whose scenes the prior has noised already.

        Raises:
            InvalidInputError: an advantage has neither one value per scene nor one per slot.
        """
        keys = self.tensor_keys
        text, scene = self._text(flat), flat.get(keys.scene)
        advantage = self._advantage(flat, keys.advantage, scene)
        credit = scene.new_zeros(len(scene), 1)
        if flat.get(keys.category_advantage, None) is not None:
            credit = self._advantage(flat, keys.category_advantage, scene)
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
        valid = flat.get(keys.valid, None)
        kept = torch.ones(len(scene), dtype=torch.bool, device=scene.device) if valid is None else valid.reshape(-1)
        losses, expectation, distance = (
            torch.where(kept, values, 0.0).sum() / kept.sum().clamp(min=1) for values in (losses, expectation, distance)
        )
        found = {"loss_objective": losses, "loss_expectation": expectation, "distance": distance.sqrt()}
        return TensorDict(found, [])


class NFTLoss(ForwardProcessLoss):
    """Negative-aware fine-tuning (Zheng et al. 2025, arXiv 2509.16117), for poses and, on logits, for categories.

    With the optimality r = 1/2 + clip(A / c, -1, 1) / 2 and the implicit policies

        o_plus = (1 - beta) o_old + beta o,    o_minus = (1 + beta) o_old - beta o

    the loss is r |o_plus - target|^2 + (1 - r) |o_minus - target|^2. Its minimum over o at one x_t is
    o_old + E[(2 r - 1) (target - o_old)] / beta. The step is thus at most the mean absolute error of o_old divided by
    beta. The category loss has the same form, with cross-entropies of the logits l_plus and l_minus. These combine
    logits in the way that o_plus and o_minus combine outputs. Arguments are those of :class:`ForwardProcessLoss`;
    smaller values of ``beta`` step further from the sampling policy.

    >>> from agents.priors.testing import tiny_prior
    >>> import torch
    >>> from tensordict import TensorDict
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> scenes = TensorDict({"scene": prior.encode(prior.sample(2, num_steps=3)), "advantage": torch.ones(2, 34)}, [2])
    >>> loss = NFTLoss(prior, prior)(scenes)
    >>> sorted(loss.keys()), float(loss["distance"])
    (['distance', 'loss_expectation', 'loss_objective'], 0.0)
    >>> loss["loss_objective"].backward()
    """

    default_beta = 0.5

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        good = self.optimality(advantage)
        change, error = self.beta * (output - old), target - old
        return good * (change - error).square() + (1 - good) * (change + error).square()

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        good = self.optimality(advantage)
        change = self.beta * (logits - old)
        return good * _cross_entropy(old + change, category) + (1 - good) * _cross_entropy(old - change, category)

    def optimality(self, advantage: Tensor) -> Tensor:
        """The optimality r of an advantage, in [0, 1]."""
        return 0.5 + 0.5 * (advantage / self.clip).clamp(-1.0, 1.0)


class AWMLoss(ForwardProcessLoss):
    """Advantage weighted matching (Xue et al. 2025, arXiv 2509.25050) with a pull to the sampling policy.

    With a = clip(A / c, -1, 1), the loss of a continuous entry is a |o - target|^2 + beta |o - o_old|^2. This loss is
    bounded below for beta > 1. The loss of a category is a times its cross-entropy plus beta KL(p_old || p). For a bad
    sample it is bounded below if beta times p_old of the category exceeds -a. At o = o_old the gradient is that of
    :class:`NFTLoss` divided by the beta of :class:`NFTLoss`. Arguments are those of :class:`ForwardProcessLoss`;
    ``beta`` is the strength of the pull.
    """

    default_beta, least_beta = 2.0, 1.0

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        bounded = (advantage / self.clip).clamp(-1.0, 1.0)
        return bounded * (output - target).square() + self.beta * (output - old).square()

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        bounded = (advantage / self.clip).clamp(-1.0, 1.0)
        pull = F.kl_div(logits.log_softmax(-1), old.log_softmax(-1), reduction="none", log_target=True).sum(dim=-1)
        return bounded * _cross_entropy(logits, category) + self.beta * pull


class Expectation(nn.Module):
    """Copy of the denoiser that learns, with AdamW, the mean target at a noised scene over the sampling policy's
    scenes. A forward-process loss otherwise takes the output of the sampling policy as this mean, which it is not,
    because a policy in training is no exact denoiser of its own samples. Where all samples are bad, the difference
    repels the output, the sampling policy follows, and the difference grows. With the learned mean, only the covariance
    of target and advantage is left, as in a policy gradient with an exact baseline.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)))
    >>> expectation = Expectation(prior)
    >>> bool((expectation(noised) == prior.output(noised).continuous).all())
    True
    """

    def __init__(self, prior: ScenePrior, learning_rate: float = 3e-4) -> None:
        super().__init__()
        self.prior = deepcopy(prior).requires_grad_(True)
        self.prior.freeze_text()
        self.trained = [p for p in self.prior.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(self.trained, lr=learning_rate, weight_decay=0.0)

    def forward(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B, N, F) expected targets."""
        return self.prior.output(noised, text).continuous

    def step(self, clip: float = 1.0) -> None:
        """Apply the gradient that all processes accumulated; one that is not finite is dropped."""
        ProcessGroup.current().sum_gradients(self.trained)
        if bool(torch.isfinite(nn.utils.clip_grad_norm_(self.trained, clip))):
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def return_to(self, prior: ScenePrior) -> None:
        """Take the weights of ``prior``, and forget the optimiser's state."""
        self.prior.load_state_dict(prior.state_dict())
        self.optimizer.state.clear()

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"weights": self.prior.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.prior.load_state_dict(state["weights"])
        self.optimizer.load_state_dict(state["optimizer"])


class ForwardProcess(AveragedSampler):
    """Algorithm of NFT and AWM, which differ in their loss; see :class:`ForwardProcessLoss`.

    A slower copy of the prior in training, an average of its weights, samples the scenes. This copy is also evaluated
    and saved. ``expectation`` is a copy of the denoiser that learns the mean of the samples, None for none. The sigmas
    ``stds`` are not used.
    """

    loss: ForwardProcessLoss

    def __init__(self, settings: ForwardProcessSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        super().__init__(policy, sampler_decay=settings.sampler_decay)
        self.settings = settings
        self.advantage = ForwardAdvantage(credit=settings.credit, category_credit=settings.category_credit)
        rate = settings.expectation_lr
        self.expectation = Expectation(self.sampler, rate) if rate else None
        self.loss = self.make_loss(settings)

    def make_loss(self, settings: Any) -> ForwardProcessLoss:
        """The loss of these settings; an algorithm with another loss overrides this method."""
        kind = NFTLoss if isinstance(settings, NFTSettings) else AWMLoss
        return kind(
            self.prior, self.sampler, beta=settings.beta, clip=settings.advantage_clip, expectation=self.expectation
        )

    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """Add the gradient of a batch to ``.grad``: ``draws`` timesteps and noises of every scene.

        With several processes, ``.grad`` gets the part of this process's scenes in the mean over all scenes.
        """
        x0 = self.prior.encode(finished_scenes(batch))
        scenes = batch.exclude("next", "timestep")[:, -1].set("scene", x0)
        processes = ProcessGroup.current()
        valid = max(1.0, processes.sum_numbers(int(scenes["valid"].sum()))[0])
        everything, own = gather_rows(x0), processes.rows(processes.size * len(x0))
        draws = [self.prior.noised(everything, generator).rows(own) for _ in range(self.settings.draws)]
        total, squares = 0.0, 0.0
        learned = [] if self.expectation is None else self.expectation.trained
        for rows in in_parts([*self.prior.parameters(), *learned], len(x0), self.policy.chunk):
            part = scenes[rows]
            share = int(part["valid"].sum()) / valid / self.settings.draws
            for noised in draws:
                result = self.loss.of_noised(noised.rows(rows), part)
                objective = result["loss_objective"] * share
                (objective + result["loss_expectation"] * share).backward()
                total += float(objective.detach())
                squares += share * float(result["distance"]) ** 2
        if self.expectation is not None:
            self.expectation.step()
        total, squares = processes.sum_numbers(total, squares)
        return BatchGradient(total, {"distance": squares**0.5})

    def return_to(self, prior: ScenePrior) -> None:
        """Sample with the weights of ``prior``; the expectation begins with them as well."""
        super().return_to(prior)
        if self.expectation is not None:
            self.expectation.return_to(prior)

    def state(self) -> dict[str, Any]:
        """The state of the sampling policy, and that of the expectation."""
        return {**super().state(), "expectation": None if self.expectation is None else self.expectation.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        super().restore(state)
        if self.expectation is not None:
            self.expectation.restore(state["expectation"])


def _cross_entropy(logits: Tensor, category: Tensor) -> Tensor:
    return F.cross_entropy(logits.flatten(0, 1), category.flatten(), reduction="none").view(category.shape)
