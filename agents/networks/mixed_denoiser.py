"""The denoiser of a mixed prior: a network together with its two diffusion processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.diffusion import CategoricalProcess, GaussianProcess
from agents.diffusion.gaussian import Moments
from agents.diffusion.reverse_steps import state_of
from agents.networks.bert import BertEncoder
from agents.networks.denoiser import autocast
from agents.networks.packing import run_packed, take_slots
from agents.networks.text import Text, TextEncoder
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import POSE_FEATURES

EMPTY_SLOTS = ("attended", "dropped")
"""Treatments of slots that are known to be empty."""

_CERTAIN = 30.0
"""Difference (nats) of the logit of a known category to those of the others."""


@dataclass(frozen=True)
class Observed:
    """Entries of scenes that are observed exactly: the network sees them without noise, chains keep them.

    Attributes:
        x: (B, N, D) scenes; only observed entries are read.
        pose: (B, N) bool.
        category: (B, N) bool.
    """

    x: Tensor
    pose: Tensor
    category: Tensor

    def rows(self, rows: slice) -> Observed:
        """The observed entries of some of the scenes."""
        return Observed(self.x[rows], self.pose[rows], self.category[rows])

    def flags(self) -> Tensor:
        """(B, N) int64 as the network reads them: 1 where the pose is observed, plus 2 where the category is."""
        return self.pose.long() + 2 * self.category.long()

    def entries(self) -> Tensor:
        """(B, N, D) bool."""
        is_pose = torch.arange(self.x.shape[-1], device=self.x.device) < POSE_FEATURES
        return torch.where(is_pose, self.pose[..., None], self.category[..., None])

    def write(self, x: Tensor) -> Tensor:
        """``x`` (B, N, D) with the observed entries in place."""
        return torch.where(self.entries(), self.x, x)


class MixedDenoiser(nn.Module):
    """x_t (B, N, 12 + K) and t (B,) to the clean pose (B, N, 12) and logits of the clean category (B, N, K).

    Attributes:
        precision: number format of the network alone (``torch.bfloat16`` for autocast); chains are always float32.
    """

    def __init__(
        self,
        network: nn.Module,
        poses: GaussianProcess,
        categories: CategoricalProcess,
        text_encoder: TextEncoder | BertEncoder | None = None,
        empty_slots: str = "attended",
    ) -> None:
        super().__init__()
        if empty_slots not in EMPTY_SLOTS:
            raise unknown_name("treatment of empty slots", empty_slots, EMPTY_SLOTS)
        self.drops_empty = empty_slots == "dropped"
        if self.drops_empty and not categories.only_absorbs:
            raise InvalidInputError(
                f"empty_slots='dropped' needs a kernel that only absorbs, not {categories.schedule.name!r}: "
                "a slot that is visibly empty must be empty; take kernel='early_absorbing'"
            )
        by_category = poses.preconditioning.by_category
        mean, std = (None, None) if by_category is None else by_category.given_state(categories)
        self._mean: Tensor | None
        self._std: Tensor | None
        self.register_buffer("_mean", mean, persistent=False)
        self.register_buffer("_std", std, persistent=False)
        self.network = network
        self.reads_log_noise = getattr(network.config, "time_input", "timestep") == "log_noise"
        self.precision = torch.float32
        self.text_encoder = text_encoder
        self.poses = poses
        self.categories = categories

    def groups_by_number(self, text: Text) -> Tensor | None:
        """(B, K) int64 groups of categories by the numbers that ``text`` gives; None if the network has none."""
        grouped = getattr(self.network, "groups_by_number", None)
        return None if grouped is None else grouped(text[0])

    def moments(self, states: Tensor, t: Tensor) -> Moments | None:
        """Mean and std (B, N, 12) of clean poses, given their categories in ``states`` (B, N) at ``t`` (B,).

        None where the preconditioning does not tell categories apart.
        """
        if self._mean is None or self._std is None:
            return None
        return self._mean[t[:, None], states], self._std[t[:, None], states]

    def output(
        self, x_t: Tensor, t: Tensor, observed: Observed | None = None, text: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """The raw pose output, in the units of ``poses.target``, and logits.

        Args:
            x_t: (B, N, 12 + K), observed entries in place.
            t: (B,) timesteps.
            observed: which entries carry no noise.
            text: (B, L, W) tokens and (B, L) their mask.
        """
        pose, states = x_t[..., :POSE_FEATURES], state_of(x_t[..., POSE_FEATURES:])
        alpha, _ = self.poses.rates(t, pose)
        ratio = (self.poses.sigma[t.cpu()] / self.poses.alpha[t.cpu()]).to(x_t.device)
        level = ratio[:, None].expand(pose.shape[:2])
        scaled = self.poses.network_input(pose, t)
        position = pose / alpha
        if observed is not None:
            exact = observed.pose[..., None]
            scaled = torch.where(exact, self.poses.network_input(pose, torch.zeros_like(t)), scaled)
            position = torch.where(exact, pose, position)
            level = torch.where(observed.pose, torch.zeros_like(level), level)
        time = 250.0 * ratio.log() if self.reads_log_noise else (t - 1).to(pose.dtype)
        inputs = [scaled, states, position, level, *([] if observed is None else [observed.flags()])]
        if self.drops_empty:
            output, logits = self._on_present(inputs, time, text)
            return output, torch.where((states < self.categories.categories)[..., None], self._certain(states), logits)
        return self._run(inputs, time, text)

    def _run(
        self, inputs: Sequence[Tensor], time: Tensor, text: Text | None, slot_mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The network on scaled poses, states, positions, noise levels and, where there are any, observed flags."""
        scaled, states, position, level, *flags = inputs
        tokens, mask = (None, None) if text is None else text
        extra = {} if slot_mask is None else {"slot_mask": slot_mask}
        with autocast(scaled, self.precision):
            output, logits = self.network(
                scaled,
                states,
                time,
                text=tokens,
                text_mask=mask,
                position=position,
                noise_level=level,
                observed=flags[0] if flags else None,
                **extra,
            )
        return output.to(scaled.dtype), logits.to(scaled.dtype)

    def _on_present(self, inputs: Sequence[Tensor], time: Tensor, text: Text | None) -> tuple[Tensor, Tensor]:
        """The network on the slots that are not known to be empty; 0 on the others."""
        present = inputs[1] != self.categories.categories - 1

        def run(rows: Tensor, index: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
            words = None if text is None else (text[0][rows], text[1][rows])
            attended = mask | ~mask.any(dim=1, keepdim=True)  # a scene of padding alone attends to it, unused
            return self._run([take_slots(x, rows, index) for x in inputs], time[rows], words, attended)

        return run_packed(present, run, (POSE_FEATURES, self.categories.categories))

    def _certain(self, states: Tensor) -> Tensor:
        """(B, N, K) logits that are certain of the category that a state shows."""
        count = self.categories.categories
        return _CERTAIN * (F.one_hot(states.clamp(max=count - 1), count).float() - 1.0)

    def forward(
        self, x_t: Tensor, t: Tensor, observed: Observed | None = None, text: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """The clean pose (B, N, 12), normalised, and the logits of the clean category (B, N, K)."""
        output, logits = self.output(x_t, t, observed, text)
        moments = self.moments(state_of(x_t[..., POSE_FEATURES:]), t)
        return self.poses.x0_from_output(x_t[..., :POSE_FEATURES], t, output, moments), logits
