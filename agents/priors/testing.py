"""Untrained priors with very small networks, for tests and examples."""

from __future__ import annotations

import torch
from torch import nn

from agents.diffusion import Preconditioning
from agents.networks import FluxConfig, MixedFluxConfig, TextConfig
from agents.networks.flux_modules import FourierFeaturesConfig, ObservedFlagsConfig
from agents.priors.config import PROCESSES, MixedPriorConfig, PriorConfig
from agents.priors.continuous import ContinuousPrior
from agents.priors.mixed import MixedPrior, prompt_words
from agents.priors.prior import ScenePrior
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE_FEATURES
from scene_envs.scene_types import SceneType, get_scene_type


def tiny_prior(
    scene_type: str | SceneType = "dimsum_table",
    seed: int = 0,
    slots: int | None = None,
    process: str = "continuous",
    text: bool = False,
    kernel: str = MixedPriorConfig.kernel,
) -> ScenePrior:
    """An untrained prior with a very small network and random weights, for tests and examples.

    Args:
        scene_type: scene type or its name.
        seed: seed of the weights.
        slots: slots per scene; the scene type's when None.
        process: ``"continuous"`` or ``"mixed"``.
        text: whether it reads prompts, with the vocabulary of prompts about scenes of this type; mixed only.
        kernel: categorical kernel; mixed only.
    """
    scene_type = get_scene_type(scene_type)
    if process not in PROCESSES:
        raise unknown_name("process", process, PROCESSES)
    if text and process != "mixed":
        raise InvalidInputError("text=True needs process='mixed': the continuous prior reads no prompts")
    slots = scene_type.slots if slots is None else slots
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        prior = _mixed(scene_type, slots, text, kernel) if process == "mixed" else _continuous(scene_type, slots)
        for parameter in prior.parameters():
            if not bool(parameter.any()):
                nn.init.normal_(parameter, std=0.02)
    return prior.eval()


def _continuous(scene_type: SceneType, slots: int) -> ScenePrior:
    features = scene_type.features
    config = PriorConfig(scene_type.name, slots, FluxConfig(features=features, hidden=32, depth=2, heads=2))
    moments = Preconditioning(torch.zeros(features), torch.full((features,), 0.5))
    return ContinuousPrior(config, _workspace_normalizer(scene_type), moments)


def _mixed(scene_type: SceneType, slots: int, text: bool, kernel: str) -> ScenePrior:
    reader = TextConfig(prompt_words(scene_type), width=16, depth=1, heads=2, latents=4) if text else None
    network = MixedFluxConfig(
        scene_type.num_assets + 1,
        hidden=32,
        double_blocks=1,
        single_blocks=2,
        heads=2,
        embedding=32,
        pose_head=16,
        text_width=0 if reader is None else reader.width,
        time_input="log_noise",
        modules=(ObservedFlagsConfig(), FourierFeaturesConfig()),
    )
    config = MixedPriorConfig(scene_type.name, slots, network, text=reader, kernel=kernel)
    moments = Preconditioning(torch.zeros(POSE_FEATURES), torch.full((POSE_FEATURES,), 0.5))
    return MixedPrior(config, _workspace_normalizer(scene_type), moments)


def _workspace_normalizer(scene_type: SceneType) -> Normalizer:
    """A normalizer made from the scene type alone: workspace, yaw-only rotations, one-hot categories."""
    low, high = (torch.tensor(corner) for corner in scene_type.workspace)
    yaw_low = torch.tensor([-1.0, -1, 0, -1, -1, 0, 0, 0, 0])
    yaw_high = torch.tensor([1.0, 1, 0, 1, 1, 0, 0, 0, 1])
    flags = torch.ones(scene_type.num_assets + 1)
    return Normalizer.from_range(torch.cat([low, yaw_low, 0 * flags]), torch.cat([high, yaw_high, flags]))
