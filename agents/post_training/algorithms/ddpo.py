"""DDPO on a denoising policy: advantages, loss and gradient of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from agents.post_training.algorithms.base import (
    Advantage,
    Algorithm,
    BatchGradient,
    PlainLoss,
    accepted_keys,
    bounded_ratio,
    in_parts,
)
from agents.post_training.policy import DenoisingPolicy, gradient_weights
from agents.post_training.settings import DDPOISSettings, DDPOSFSettings
from agents.utils.process_group import ProcessGroup
from scene_envs.errors import InvalidInputError


class DDPOSFLoss(PlainLoss):
    """Denoising diffusion policy optimisation (Black et al. 2024), Eq. 3 (score function) or Eq. 4 (clipped).

    For transitions (x_t, t, x_{t-1}) with advantage A, the loss is

        - mean over valid rows of  weight(t) * A * log p(x_{t-1} | x_t)

    where x_t and x_{t-1} are constants, so the gradient is that of the score function. The graph of one step can be
    freed before the next is built, so memory does not grow with the length of the chain. Known entries, the
    deterministic last step and steps of weight 0 do not enter the loss.

    log p is a mean over the random entries of a scene, as in the published code. This decides the scale of the
    gradient, and so the meaning of the coefficient of any other loss. Over rows the loss is a mean, never over steps.

    With ``clip_epsilon``, ``min(ratio * A, clip(ratio, 1 ± epsilon) * A)`` replaces A * log p. The ratio is that of the
    *reduced* probabilities to those stored at sampling; before the first update it is exactly 1.

    Accepted keys (``set_keys`` renames them):
        scene: (B, N, D) float, x_t.
        timestep: (B, 1) int64, t.
        action: (B, N, D) float, x_{t-1}.
        advantage: (B,) or (B, 1) float, or (B, N) for credit per slot.
        sample_log_prob: (B, N) float, log-probability per slot at sampling, by default under ``"slot_log_prob"``; read
            when clipping, and optional without.
        valid: (B,) or (B, 1) bool, optional; False rows are left out of the mean.
            :class:`~agents.post_training.Advantage` writes it for all steps of a scene that the reward could not score.
        text, text_mask: (B, L, W) tokens and (B, L) their mask, optional, as the policy saw them.
        prompt: (B, L) int64 token indices, optional, read where ``text`` is missing.

    Args:
        policy: policy that is optimised.
        step_weights: (S,) weight of every step; None means 1 wherever the step is random.
        clip_epsilon: half-width of the ratio's clip, or None for the plain score function.

    Returns (``forward``): ``loss_objective`` (), and detached ``log_ratio`` (), the largest |log ratio|, and
    ``clip_fraction`` (); both are 0 where no old log-probabilities are given.

    >>> from agents.priors.testing import tiny_prior
    >>> policy = DenoisingPolicy(tiny_prior(), num_steps=4)
    >>> scene = policy.prior.initial(2, 34)
    >>> action, log_prob = policy.draw(scene, 1)
    >>> transitions = TensorDict({"scene": scene, "timestep": policy.table.timesteps[1].expand(2, 1),
    ...     "action": action, "advantage": torch.tensor([1.0, -1.0]), "slot_log_prob": log_prob}, [2])
    >>> loss = DDPOSFLoss(policy)(transitions)
    >>> sorted(loss.keys()), float(loss["log_ratio"])
    (['clip_fraction', 'log_ratio', 'loss_objective'], 0.0)
    >>> loss["loss_objective"].backward()
    """

    default_keys = _AcceptedKeys = accepted_keys(
        "scene", "timestep", "action", "advantage", "valid", "prompt", sample_log_prob="slot_log_prob"
    )
    required = ("scene", "timestep", "action", "advantage")
    out_keys = ["loss_objective", "log_ratio", "clip_fraction"]  # noqa: RUF012  (torchrl reads lists)
    policy: DenoisingPolicy
    step_weights: Tensor

    def __init__(
        self, policy: DenoisingPolicy, *, step_weights: Tensor | None = None, clip_epsilon: float | None = None
    ) -> None:
        super().__init__()
        if clip_epsilon is not None and not 0 < clip_epsilon < 1:
            raise InvalidInputError(f"clip_epsilon={clip_epsilon} must lie between 0 and 1, or be None")
        if step_weights is not None and step_weights.shape != (len(policy),):
            raise InvalidInputError(
                f"step_weights has shape {tuple(step_weights.shape)}, the chain {len(policy)} steps"
            )
        self.policy, self.clip_epsilon = policy, clip_epsilon
        weights = torch.ones(len(policy)) if step_weights is None else step_weights.float()
        self.register_buffer("step_weights", weights)
        self._entries: dict[int, int] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """The loss of a batch of transitions; rows may be at different steps.

        Raises:
            InvalidInputError: a timestep the policy does not visit, or clipping without old log-probabilities.
        """
        keys = self.tensor_keys
        flat = tensordict.reshape(-1)
        scene, action = flat.get(keys.scene).detach(), flat.get(keys.action).detach()
        timestep = flat.get(keys.timestep).reshape(-1)
        advantage = self._advantage(flat, keys.advantage, scene)
        old = flat.get(keys.sample_log_prob, None)
        if old is None and self.clip_epsilon is not None:
            raise InvalidInputError(f"clipping needs the log-probabilities at sampling under {keys.sample_log_prob!r}")
        valid = flat.get(keys.valid, None)
        kept = torch.ones_like(timestep, dtype=torch.bool) if valid is None else valid.reshape(-1)
        text, prompt = self._text(flat), flat.get(keys.prompt, None)
        if text is None and prompt is not None:
            text = self.policy.read(prompt)
        total = scene.new_zeros(())
        largest, clipped = scene.new_zeros(()), scene.new_zeros(())
        for t in timestep.unique().tolist():
            rows = timestep == t
            step = self.policy.step_of(int(t))
            part_text = None if text is None else (text[0][rows], text[1][rows])
            log_prob = self.policy.log_prob(scene[rows], step, action[rows], part_text)  # (b, N)
            earlier = None if old is None else old[rows].detach()
            if earlier is not None:
                largest = torch.maximum(largest, (log_prob.detach() - earlier).sum(dim=-1).abs().max())
            objective, beyond = self._objective(log_prob, advantage[rows], earlier)
            total = total + self.step_weights[step] * torch.where(kept[rows], objective, 0.0).sum()
            clipped = clipped + torch.where(kept[rows], beyond, 0.0).sum()
        count = kept.sum().clamp(min=1)
        return TensorDict(
            {"loss_objective": -total / count, "log_ratio": largest, "clip_fraction": clipped / count}, []
        )

    def _objective(self, log_prob: Tensor, advantage: Tensor, old: Tensor | None) -> tuple[Tensor, Tensor]:
        """(b,) objective and (b,) share of clipped terms, from (b, N) log-probabilities and advantages."""
        slots = log_prob.shape[1]
        if slots not in self._entries:
            self._entries[slots] = self.policy.random_entries(slots)
        entries = self._entries[slots]
        if advantage.shape[1] == 1:  # credit per scene
            log_prob = log_prob.sum(dim=1, keepdim=True)
            old = None if old is None else old.sum(dim=1, keepdim=True)
        log_prob = log_prob / entries
        if self.clip_epsilon is None or old is None:
            return (advantage * log_prob).sum(dim=1), torch.zeros_like(advantage[:, 0])
        ratio = bounded_ratio(log_prob - old / entries)
        bounded = ratio.clamp(1 - self.clip_epsilon, 1 + self.clip_epsilon)
        surrogate = torch.minimum(ratio * advantage, bounded * advantage)
        return surrogate.sum(dim=1), (ratio != bounded).float().mean(dim=1).detach()


class DDPO(Algorithm):
    """DDPO-SF, or DDPO-IS if given the settings of DDPO-IS (Black et al. 2024). The ``step_weights`` (S,) of its loss
    say which steps of ``policy`` enter the gradient; they follow from ``stds`` (S,), the smallest sigma of every step,
    normalised units.
    """

    loss: DDPOSFLoss

    def __init__(self, settings: DDPOSFSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        self.settings, self.policy = settings, policy
        self.advantage = Advantage(credit=settings.credit)
        weights = gradient_weights(stds, min_std=settings.min_std)
        clip = settings.clip_epsilon if isinstance(settings, DDPOISSettings) else None
        self.loss = DDPOSFLoss(policy, step_weights=weights, clip_epsilon=clip).to(next(policy.parameters()).device)

    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """Add the policy gradient of a batch to ``.grad``; ``generator`` draws the steps that enter it."""
        eligible = torch.nonzero(self.loss.step_weights.cpu() > 0).flatten()
        chosen = eligible[torch.randperm(len(eligible), generator=generator)[: self.settings.gradient_steps]]
        scale = len(eligible) / len(chosen)  # of the sum over these steps to that over all
        return accumulate_policy_gradient(self.loss, batch, sorted(chosen.tolist()), scale=scale)


def accumulate_policy_gradient(
    loss: DDPOSFLoss, batch: TensorDictBase, steps: Sequence[int], *, scale: float = 1.0
) -> BatchGradient:
    """Add ``scale`` times the policy gradient of whole episodes [B, S], summed over ``steps``, to ``.grad``. It is
    computed for one step, and for ``chunk`` scenes of the policy, at a time, so memory does not depend on the number of
    steps. With several processes, ``.grad`` gets the part of this process's scenes in the mean over all scenes.
    """
    total, largest, clipped = 0.0, 0.0, 0.0
    valid = batch["valid"][:, -1, 0]
    processes = ProcessGroup.current()
    valid_count = max(1.0, processes.sum_numbers(int(valid.sum()))[0])
    for rows in in_parts(loss.policy.parameters(), len(valid), loss.policy.chunk):
        share = int(valid[rows].sum()) / valid_count  # turns a chunk's mean into its part of the batch's mean
        for step in steps if share else ():
            result = loss(batch[rows, step])
            objective = result["loss_objective"] * (scale * share)
            objective.backward()
            total += float(objective.detach())
            largest = max(largest, float(result["log_ratio"]))
            clipped += float(result["clip_fraction"]) * share / len(steps)
    total, clipped = processes.sum_numbers(total, clipped)
    return BatchGradient(total, {"log_ratio": max(processes.gather(largest)), "clip_fraction": clipped})
