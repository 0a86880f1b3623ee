"""Fresh priors for a pretraining run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from agents.continuous_prior import ContinuousPrior
from agents.denoiser import PriorConfig
from agents.diffusion import CategoryMoments, Preconditioning
from agents.mixed_denoiser import MixedPriorConfig
from agents.mixed_prior import MixedPrior
from agents.networks import FluxConfig, TextConfig, vocabulary
from agents.networks.registry import ContinuousNetworkConfig, network_config
from agents.pretrain_config import PretrainConfig
from agents.prior import PROCESSES, ScenePrior
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE
from scene_envs.scene_types import get_scene_type

MOMENTS = ("category", "feature", "scene")
"""Whose mean and standard deviation precondition a network."""


def build_prior(
    config: PretrainConfig, raw: Tensor, normalizer: Normalizer, prompts: Sequence[Sequence[str]] = ()
) -> ScenePrior:
    """A fresh prior whose preconditioning is fitted to the raw scenes (M, N, D).

    Args:
        config: the run.
        raw: scenes.
        normalizer: of raw scenes.
        prompts: prompts of every scene, from which a prior that reads them takes its vocabulary.
    """
    scene_type = get_scene_type(config.scene)
    fixed = len(scene_type.fixed)
    if config.process == "continuous":
        if config.text:
            raise InvalidInputError("text=true needs process=mixed: the continuous prior reads no prompts")
        network = FluxConfig(scene_type.features, config.hidden, config.depth, config.heads)
        prior_config = PriorConfig(config.scene, raw.shape[1], network, config.schedule, config.prediction)
        torch.manual_seed(config.seed)
        sample = normalizer.normalize(raw[:20_000])
        return ContinuousPrior(prior_config, normalizer, Preconditioning.fit(sample[:, fixed:]))
    if config.process != "mixed":
        raise unknown_name("process", config.process, PROCESSES)
    text = TextConfig(vocabulary(prompt for group in prompts for prompt in group)) if config.text else None
    mixed_network = network_config(
        config.network,
        "mixed",
        features=scene_type.features,
        categories=scene_type.num_assets + 1,
        hidden=config.hidden,
        depth=config.depth,
        heads=config.heads,
        text_width=0 if text is None else text.width,
        attention=config.attention,
        frequencies=config.frequencies,
        unit=_unit(normalizer),
    )
    if isinstance(mixed_network, ContinuousNetworkConfig):
        raise TypeError("the registry gave a continuous network for a mixed prior")
    mixed_config = MixedPriorConfig(
        config.scene,
        raw.shape[1],
        mixed_network,
        config.schedule,
        config.prediction,
        config.kernel,
        translation_weight=config.translation_weight,
        category_loss=config.category_loss,
        text=text,
        noise_floor=config.noise_floor,
        noise_ceiling=config.noise_ceiling,
        empty_slots=config.empty_slots,
        timesteps=config.timesteps,
        loss_weighting=config.loss_weighting,
    )
    torch.manual_seed(config.seed)
    return MixedPrior(mixed_config, normalizer, _pose_moments(config.moments, raw[:20_000, fixed:], normalizer))


def _pose_moments(kind: str, raw: Tensor, normalizer: Normalizer) -> Preconditioning:
    """Moments of the normalised poses of all objects of raw scenes (M, N, D)."""
    if kind not in MOMENTS:
        raise unknown_name("moments", kind, MOMENTS)
    objects = raw[raw[..., -1] == 0]
    poses = normalizer.normalize(objects)[..., : POSE.stop]
    moments = Preconditioning.fit(poses)
    if kind == "scene":
        return moments.pooled()
    if kind == "feature":
        return moments
    categories = raw[..., POSE.stop :].argmax(dim=-1).flatten()
    every = normalizer.normalize(raw).flatten(0, 1)[:, : POSE.stop]
    by_category = CategoryMoments.fit(every, categories, raw.shape[-1] - POSE.stop)
    return replace(moments, by_category=by_category)


def _unit(normalizer: Normalizer) -> tuple[float, float, float]:
    """Metres per normalised unit along x, y, z; 0 along an axis that never varies."""
    scale = normalizer.scale[:3]
    x, y, z = torch.where(scale == 0, torch.zeros_like(scale), 1.0 / scale.clamp(min=1e-9)).tolist()
    return x, y, z
