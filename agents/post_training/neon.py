"""Neon: negative extrapolation from self-training, an algorithm that needs no reward."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from agents.networks.text import Text
from agents.post_training.algorithm_settings import NeonSettings
from agents.post_training.expectation import TrainedCopy
from agents.post_training.own_sample_loss import OwnSampleLoss
from agents.post_training.own_samples import OwnSampleAlgorithm
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import Rollout
from agents.priors.prior import NoisedScenes, ScenePrior


class SelfTrainingLoss(OwnSampleLoss):
    """Pretraining loss of a copy of the denoiser on finished scenes, as ``loss_expectation``.

    ``loss_objective`` is 0: the prior in training gets no gradient from its own samples.

    Args:
        prior: prior that is trained elsewhere, on real scenes; this loss uses it to noise the scenes.
        copy: copy that is trained on the scenes.
        generator: source of timesteps, noise and observed entries (CPU); None for torch's own.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> scenes = TensorDict({"scene": prior.encode(prior.sample(2, num_steps=3))}, [2])
    >>> loss = SelfTrainingLoss(prior, copy=TrainedCopy(prior, 1e-4))(scenes)
    >>> float(loss["loss_objective"]), float(loss["loss_expectation"]) > 0
    (0.0, True)
    """

    def __init__(self, prior: ScenePrior, *, copy: TrainedCopy, generator: Generator | None = None) -> None:
        super().__init__(prior, generator=generator)
        self.copy = copy

    def of_scenes(self, noised: NoisedScenes, text: Text | None, flat: TensorDictBase) -> Mapping[str, Tensor]:
        """(B,) zeros, and (B,) losses of the copy."""
        own = self.copy.prior.noised_loss(noised, text)
        return {"loss_objective": own.new_zeros(len(own)), "loss_expectation": own}


class Neon(OwnSampleAlgorithm):
    """Negative extrapolation from self-training (Alemohammad et al. 2025, arXiv 2510.03597), in rounds.

    A round lasts ``settings.period`` iterations, in which the prior theta samples all scenes. Two copies of theta are
    trained with the pretraining loss, with the same timesteps and noise. The training loop trains one copy on real
    scenes (theta_real); the other copy is trained on the samples (theta_own). The next round begins with
    theta + w (theta_real - theta_own). Some changes by training do not depend on the scenes. They are the same in both
    copies, so they cancel in the difference. Within a round, the learning rate of both copies falls from
    ``optimizer.lr`` to 0.

    Args:
        settings: settings of the algorithm.
        policy: policy of the prior that is trained on real scenes.
        stds: sigmas of the reverse steps; not used.
    """

    copy: TrainedCopy

    def __init__(self, settings: NeonSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        super().__init__(policy, draws=settings.draws, sampler_decay=0.0)
        self.period, self.weight, self.updates = settings.period, settings.w, settings.updates
        self.copy = TrainedCopy(self.prior, settings.learning_rate)
        self.loss = SelfTrainingLoss(self.prior, copy=self.copy)
        self.iterations = 0

    def real_generator(self, own: Generator, real: Generator) -> Generator:
        """The generator of the own samples, so that both copies see the same timesteps and noise."""
        return own

    def advantage(self, rollout: Rollout) -> TensorDict:
        """No keys: the samples are not weighted."""
        return TensorDict({}, [len(rollout.reward)])

    def learning_rate(self, rate: float, update: int) -> float:
        """The learning rate of both copies; sets that of the copy that is trained on samples."""
        place = self.iterations % self.period + update % self.updates / self.updates
        rate *= 1 - place / self.period
        for group in self.copy.optimizer.param_groups:
            group["lr"] = rate
        return rate

    def end_iteration(self) -> None:
        """At the end of a round, extrapolate and begin the next one."""
        self.iterations += 1
        if self.iterations % self.period == 0:
            real, own = (dict(module.named_parameters()) for module in (self.prior, self.copy.prior))
            theta = self._average.tensors
            self._begin({name: theta[name] + self.weight * (real[name] - own[name]).detach() for name in theta})

    def _begin(self, weights: dict[str, Tensor]) -> None:
        """Begin a round with these weights."""
        self._average.tensors = weights
        for module in (self.prior, self.copy.prior, self.sampler):
            self._average.copy_to(module)

    def return_to(self, prior: ScenePrior) -> None:
        """Begin a round with the weights of an earlier checkpoint."""
        self.iterations = 0
        self.copy.optimizer.state.clear()
        self._begin({name: p.detach().clone() for name, p in prior.named_parameters()})

    def state(self) -> dict[str, Any]:
        """The weights that sample, the state of the copy, and the number of finished iterations."""
        return {"sampler": self._average.tensors, "copy": self.copy.state(), "iterations": self.iterations}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self._average.restore(state["sampler"])
        self._average.copy_to(self.sampler)
        self.copy.restore(state["copy"])
        self.iterations = state["iterations"]
