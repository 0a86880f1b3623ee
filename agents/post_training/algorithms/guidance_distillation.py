"""Guidance distillation: training of a prior to place objects as physics guidance does."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.networks.geometry import RefinementConfig
from agents.post_training.algorithms.base import AveragedSampler, BatchGradient, PlainLoss, accepted_keys, in_parts
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import text_of
from agents.post_training.settings import GuidanceDistillationSettings, RefinementSettings
from agents.priors.guidance import PhysicsGuidance
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.utils.process_group import ProcessGroup, gather_rows
from scene_envs.errors import InvalidInputError
from scene_envs.scene import POSE_FEATURES, TRANSLATION

_MIN_STD = 1e-4
"""Smallest standard deviation of a denoised feature in the loss, normalised."""


class GuidanceDistillationLoss(PlainLoss):
    """Squared difference of denoised poses from a teacher's, divided by the variance of the denoiser's error.

    For one reverse step, the loss of an entry is an upper bound of twice the KL divergence of the prior's step from the
    teacher's: both are normal with the same variance, which includes the error of the denoised entry. With a finite
    ``huber`` it grows linearly from that error on (Huber 1964), so a few objects that move far do not decide the rest.

    Accepted keys (``set_keys`` renames them):
        scene: (B, N, D) float, scenes x_t of a chain.
        timestep: (B,) or (B, 1) int64, timesteps of these scenes.
        denoised: (B, N, 12) float, the teacher's estimate of the normalised poses of x_0.
        trained: (B, N) bool, optional, slots whose poses are trained; without it, all.
        text, text_mask: (B, L, W) tokens and (B, L) their mask, optional.

    Args:
        prior: prior that is trained.
        huber: error of an entry, in standard deviations, from which on its loss is linear.

    Returns (``forward``): ``loss_objective`` (), a mean over the trained entries of a scene, then over the scenes.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> x, table = prior.initial(2, 34), prior.step_table(4)
    >>> same = prior.transition(x, 0, table).denoised[..., :12]
    >>> states = {"scene": x, "timestep": table.timesteps[:1].expand(2), "denoised": same}
    >>> bool(GuidanceDistillationLoss(prior)(TensorDict(states, [2]))["loss_objective"] < 1e-6)
    True
    """

    default_keys = _AcceptedKeys = accepted_keys("scene", "timestep", "denoised", "trained")
    required = ("scene", "timestep", "denoised")
    out_keys = ["loss_objective"]  # noqa: RUF012  (torchrl reads lists)
    prior: ScenePrior

    def __init__(self, prior: ScenePrior, huber: float = math.inf) -> None:
        super().__init__()
        self.prior, self.huber = prior, huber

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of scenes of a chain."""
        keys, flat = self.tensor_keys, tensordict.reshape(-1)
        x, t = flat.get(keys.scene).detach(), flat.get(keys.timestep).reshape(-1)
        teacher, trained = flat.get(keys.denoised).detach(), flat.get(keys.trained, None)
        weight = self.prior.loss_weight(x.shape[1]).to(x)[:, :POSE_FEATURES].expand(len(x), -1, -1)
        weight = weight if trained is None else weight * trained[..., None]
        noised = NoisedScenes(
            x_t=x, t=t, target=teacher, weight=weight, scale=x.new_ones(len(x)),
            category=x[..., POSE_FEATURES:].argmax(dim=-1),
            observed=self.prior.observed_entries(x),
        )  # fmt: skip
        found = self.prior.denoised(noised, self.prior.output(noised, self._text(flat)))[..., :POSE_FEATURES]
        error = (found - teacher) / self._std(t, x)
        entries = 2 * F.huber_loss(error, torch.zeros_like(error), reduction="none", delta=self.huber) * weight
        losses = entries.sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp(min=1.0)
        return TensorDict({"loss_objective": losses.mean()}, [])

    def _std(self, t: Tensor, like: Tensor) -> Tensor:
        """(B, 1, 12) standard deviation of the denoised poses at timesteps (B,)."""
        levels, rows = t.unique(return_inverse=True)
        process, residual = self.prior.process, self.prior.residual
        stds = torch.stack([process.estimate(int(level), int(level) - 1, residual)[1] for level in levels])
        return stds[:, :POSE_FEATURES].to(like).clamp(min=_MIN_STD)[rows][:, None]


class GuidanceDistillation(AveragedSampler):
    """On-policy distillation of physics guidance, into all weights or into a refinement alone.

    The sampling policy, a slower copy of the prior, samples a batch of scenes without physics guidance. At the steps of
    these chains at which :class:`~agents.priors.guidance.PhysicsGuidance` acts, it corrects the scenes that the copy
    denoises, and the prior is trained to denoise the same x_t to the corrected poses. Every optimiser step draws from
    the latest ``settings.memory`` of these states, which come from the policy itself, as in DAgger (Ross et al. 2011):
    the prior learns to correct its own errors. The gradient vanishes where the guidance has nothing to correct.
    Rotations are held at those that the copy denoises, and categories get no gradient. The reward is only reported.

    With the settings of ``refinement``, a prior without a :class:`~agents.networks.geometry.Refinement` gets one, and
    all other weights are frozen.

    Attributes:
        steps: steps of the chain of ``policy`` at which the guidance moves objects; the sigmas ``stds`` are not used.

    Raises:
        InvalidInputError: the guidance acts at no step of the chain, the assets have no geometry, or the prior can have
            no refinement.
    """

    loss: GuidanceDistillationLoss

    def __init__(self, settings: GuidanceDistillationSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        prior: Any = policy.prior
        if not prior.scene_type.has_geometry:
            raise InvalidInputError(
                f"algorithm={settings.name} needs the geometry of the assets, which scene type "
                f"{prior.scene_type.name!r} does not have; take another algorithm, such as nft"
            )
        if isinstance(settings, RefinementSettings):
            network = prior.with_module(RefinementConfig.name).requires_grad_(False).denoiser.network
            network.get_submodule(RefinementConfig.name).requires_grad_(True)
        super().__init__(policy, sampler_decay=settings.sampler_decay, warm_up=0.0)
        self.settings = settings
        self.loss = GuidanceDistillationLoss(self.prior, settings.huber)
        self._teacher = DenoisingPolicy(self.sampler, len(policy), chunk=policy.chunk, independent=False)
        table: Any = policy.table
        self._stds = [self.sampler.position_std(step, table) for step in range(len(policy))]
        self.steps = [step for step, std in enumerate(self._stds) if PhysicsGuidance.acts(std)]
        if not self.steps:
            error = 1e3 * float(self._stds[-1][:2].max())
            raise InvalidInputError(
                f"algorithm={settings.name} has nothing to learn: physics guidance acts once horizontal positions are "
                f"known to 3 cm, and the error of this prior is {error:.0f} mm at the last of num_steps={len(policy)} "
                "steps; pretrain the prior for longer"
            )
        self._states: TensorDict | None = None  # of all processes, the same in each
        self._kept = False  # whether they include those of the present batch

    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """Add the gradient of ``settings.states`` states; those of a new batch are corrected and kept first.

        With several processes, ``.grad`` gets this process's part of these states.
        """
        if not self._kept:
            self._states, self._kept = self._with(batch), True
        assert self._states is not None
        processes, count = ProcessGroup.current(), self.settings.states
        drawn = torch.randint(len(self._states), (count,), generator=generator)[processes.rows(count)]
        states, total = self._states[drawn].to(batch.device), 0.0
        for rows in in_parts(self.prior.parameters(), len(states), self.policy.chunk):
            objective = self.loss(states[rows])["loss_objective"] * (len(states[rows]) / count)
            if objective.requires_grad:  # not where a refinement acts on none of the states
                objective.backward()
            total += float(objective.detach())
        moved, objects = (float(states[name].sum()) for name in ("moved", "trained"))
        total, moved, objects = processes.sum_numbers(total, moved, objects)
        return BatchGradient(total, {"correction_mm": 1e3 * moved / max(1.0, objects)})

    def _with(self, batch: TensorDictBase) -> TensorDict:
        """The latest states, with those of a batch of all processes: scene by scene, at all steps."""
        parts = [self.corrected(batch, step) for step in self.steps]
        columns = {name: torch.stack([part[name] for part in parts], dim=1) for name in parts[0].keys()}  # noqa: SIM118
        states = {name: gather_rows(column).cpu().flatten(0, 1) for name, column in columns.items()}
        if self._states is not None:
            states = {name: torch.cat([self._states[name], column]) for name, column in states.items()}
        latest = {name: column[-self.settings.memory :] for name, column in states.items()}
        return TensorDict(latest, [len(latest["scene"])])

    def end_iteration(self) -> None:
        """Move the copy that samples towards the prior in training."""
        super().end_iteration()
        self._kept = False

    def state(self) -> dict[str, Any]:
        """The averaged weights, and the states that are kept."""
        return {**super().state(), "states": None if self._states is None else self._states.to_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        super().restore(state)
        states = state["states"]
        self._states = None if states is None else TensorDict(states, [len(states["scene"])])

    @torch.no_grad()
    def corrected(self, batch: TensorDictBase, step: int) -> TensorDict:
        """The states (B,) of chains at ``step``, one of :attr:`steps`, as the loss reads them.

        ``moved`` (B, N) is how far the guidance moves each object, m.
        """
        states = batch[:, step]
        x, text = states["scene"], text_of(states)
        denoised = self._teacher.distribution(x, step, text).denoised
        assert denoised is not None
        movable = self.sampler.frame(x).free.expand(x.shape[:2])
        scenes = self.sampler.decode(denoised)
        guidance = PhysicsGuidance(self.settings.strength, movable)
        moves = guidance(step, len(self.policy), lambda: scenes, self._stds[step])
        assert moves is not None
        moves = moves.to(x) * movable[..., None]
        target = denoised[..., :POSE_FEATURES].clone()
        scale = self.sampler.normalizer.scale[TRANSLATION].to(x)
        target[..., TRANSLATION] += scale * moves
        fields: dict[str, Any] = {
            "scene": x,
            "timestep": states["timestep"],
            "denoised": target,
            "trained": movable & ~scenes.is_empty.to(x.device),
            "moved": moves.norm(dim=-1),
        }
        if text is not None:
            fields["text"], fields["text_mask"] = text
        return TensorDict(fields, [len(x)])
