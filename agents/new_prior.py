"""Fresh priors for a pretraining run."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from agents.continuous_prior import ContinuousPrior
from agents.denoiser import PriorConfig
from agents.diffusion import Preconditioning
from agents.mixed_denoiser import MixedPriorConfig
from agents.mixed_prior import MixedPrior
from agents.networks import FluxConfig, MixedFluxConfig, TextConfig, vocabulary
from agents.pretrain_config import PretrainConfig
from agents.prior import PROCESSES, ScenePrior
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE
from scene_envs.scene_types import get_scene_type


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
    mixed_network = MixedFluxConfig(
        scene_type.num_assets + 1,
        hidden=config.hidden,
        double_blocks=max(1, config.depth // 3),
        single_blocks=config.depth,
        heads=config.heads,
        embedding=config.hidden,
        text_width=0 if text is None else text.width,
    )
    mixed_config = MixedPriorConfig(
        config.scene, raw.shape[1], mixed_network, config.schedule, config.prediction, config.kernel, text=text
    )
    torch.manual_seed(config.seed)
    some = raw[:20_000, fixed:]
    present = some[..., -1] == 0
    moments = Preconditioning.fit(normalizer.normalize(some[present])[..., : POSE.stop])
    return MixedPrior(mixed_config, normalizer, moments)
