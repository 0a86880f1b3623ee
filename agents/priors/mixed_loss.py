"""The training loss of a mixed prior, and which entries are given in training."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import loss_weights
from agents.diffusion.reverse_steps import state_of
from agents.networks.mixed_denoiser import Given, Text
from agents.networks.mixed_flux_config import POSE

if TYPE_CHECKING:
    from agents.priors.mixed import MixedPrior

_EMPTY_WEIGHT = 0.1
"""Weight of the pose of an empty slot in the loss: it means nothing, but chains should not drift on it."""

_COUNT_WEIGHT = 0.5
"""Weight of the numbers that a prompt asks for, read from the text alone, where the network subtracts from them."""


def mixed_loss(
    prior: MixedPrior, x0: Tensor, generator: Generator | None, t: Tensor | None, text: Text | None
) -> Tensor:
    """(B,) mean square of the pose output plus the weighted category loss, on entries that are not given.

    Arguments as in :meth:`agents.priors.mixed.MixedPrior.pretraining_loss`.
    """
    config, device = prior.mixed, x0.device
    if t is None:
        t = prior.draw_timesteps(x0.shape[0], generator).to(device)
    noise = torch.randn(x0.shape, generator=generator).to(device)
    given = draw_given(prior, x0, generator) if config.given_share > 0 else None
    x_t = prior.add_noise(x0, t, noise)
    x_t = x_t if given is None else given.write(x_t)
    text = prior.unconditional(len(x0)) if text is None else text
    output, logits = prior.denoiser.output(x_t, t, given, text)
    pose0, category0 = x0[..., :POSE], x0[..., POSE:].argmax(dim=-1)
    moments = prior.denoiser.moments(state_of(x_t[..., POSE:]), t)
    error = output - prior.process.target(pose0, x_t[..., :POSE], t, noise[..., :POSE], moments)
    weight = prior.loss_weight(x0.shape[1])[None, :, :POSE].to(device).expand(len(x0), -1, -1)
    empty = (category0 == prior.num_categories - 1)[..., None]
    weight = torch.where(empty, _EMPTY_WEIGHT * weight, weight)
    drawn = torch.ones(x0.shape[:2], device=device)
    drawn[:, : len(prior.scene_type.fixed)] = 0.0
    if given is not None:
        weight = weight * (~given.pose)[..., None]
        drawn = drawn * (~given.category)
    if prior.denoiser.drops_empty:  # what is seen is certain
        drawn = drawn * (state_of(x_t[..., POSE:]) == prior.num_categories)
    pose_loss = (error.square() * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp(min=1.0)
    pose_loss = pose_loss * loss_weights(prior.process.schedule, t, config.prediction, config.loss_weighting).to(device)
    if config.category_loss == "bound":
        states = x_t[..., POSE:]
        losses = prior.categories.loss(category0, state_of(states), t, logits, config.auxiliary)
    else:
        losses = F.cross_entropy(logits.flatten(0, 1), category0.flatten(), reduction="none").view_as(drawn)
    category_loss = (losses * drawn).sum(dim=1) / drawn.sum(dim=1).clamp(min=1.0)
    loss = pose_loss + config.category_weight * category_loss
    requests = getattr(prior.denoiser.network, "requests", None)
    if requests is not None and text is not None:
        loss = loss + _COUNT_WEIGHT * requests.count_loss(text[0][:, : requests.things], category0)
    return loss


def draw_given(prior: MixedPrior, x0: Tensor, generator: Generator | None) -> Given:
    """Random given entries: slots (completion), all categories (rearrangement), or any attribute of any slot."""
    batch, slots = x0.shape[:2]
    kind, share = torch.rand(2, batch, 1, generator=generator)
    kind = kind / max(prior.mixed.given_share, 1e-9)  # above 1: nothing is given
    picks = torch.rand(2, batch, slots, generator=generator) < share
    whole, rearrange, free = kind < 0.5, (kind >= 0.5) & (kind < 0.75), (kind >= 0.75) & (kind < 1.0)
    pose = (whole & picks[0]) | (rearrange & picks[0] & (share < 0.5)) | (free & picks[0])
    category = (whole & picks[0]) | rearrange.expand(-1, slots) | (free & picks[1])
    fixed = torch.zeros(slots, dtype=torch.bool)
    fixed[: len(prior.scene_type.fixed)] = True
    return Given(x0, (pose | fixed).to(x0.device), (category | fixed).to(x0.device))
