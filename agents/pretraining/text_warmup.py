"""Text warm-up: training of the text encoder, before a run, to predict the object numbers of its prompts."""

from __future__ import annotations

import logging
import math

import numpy as np
import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR

from agents.pretraining.initial_prior import TrainingData
from agents.priors.prior import ScenePrior
from agents.utils.seeds import derived_generator
from scene_envs.scene import POSE_FEATURES

logger = logging.getLogger(__name__)

_RATE, _RISE = 3e-3, 0.2
"""Peak learning rate, and the share of the steps in which it rises."""


def warm_up_text(prior: ScenePrior, data: TrainingData, steps: int, batch_size: int, seed: int) -> float | None:
    """Train the text encoder, and the layers that predict numbers from it, only on prompts and counts of their scenes.

    No scene is denoised, so hundreds of such steps take a minute. The run that follows starts with predicted numbers,
    from which the network can subtract the visible objects.

    Args:
        prior: prior that is changed in place; without count conditioning it is not changed.
        data: scenes and their prompts.
        steps: number of optimiser steps.
        batch_size: number of scenes per step.
        seed: seed of all draws; the same seed gives the same weights.

    Returns:
        Mean loss of the last tenth of the steps, in nats per kind of object; None if nothing was trained.
    """
    conditioning = prior.count_conditioning
    if conditioning is None or steps < 1:
        return None
    parameters = [*prior.denoiser.text_encoder.parameters(), *conditioning.counts_out.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=_RATE, weight_decay=0.01)
    schedule = LambdaLR(optimizer, lambda step: _rate(step, steps))
    losses = []
    for step in range(steps):
        generator = derived_generator(seed, step, steps)
        scenes, prompts = data.draw(batch_size, generator, prompts=True)
        picks = torch.rand(len(prompts), generator=generator).tolist()
        texts = [group[int(pick * len(group))] for group, pick in zip(prompts, picks, strict=True)]
        asked = prior.encode_prompts(texts)[0][:, : conditioning.things]
        states = scenes[..., POSE_FEATURES:].argmax(dim=-1).to(asked.device)
        loss = conditioning.count_loss(asked, states).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        optimizer.zero_grad(set_to_none=True)
        losses.append(float(loss.detach()))
    last = losses[-max(1, steps // 10) :]
    logger.info("numbers are read from prompts at %.3f nats per kind of object after %d steps", np.mean(last), steps)
    return float(np.mean(last))


def _rate(step: int, steps: int) -> float:
    """Factor on the learning rate: a linear rise, then a fall along a cosine."""
    done = (step + 1) / steps
    return done / _RISE if done < _RISE else 0.5 * (1.0 + math.cos(math.pi * (done - _RISE) / (1.0 - _RISE)))
