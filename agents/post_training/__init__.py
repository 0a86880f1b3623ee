"""Post-training of a prior by reinforcement learning, with regularisation on real scenes."""

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from agents.post_training.algorithms.base import Advantage, Algorithm, compute_advantages
    from agents.post_training.algorithms.ddpo import DDPO, DDPOSFLoss
    from agents.post_training.algorithms.forward_process import AWMLoss, ForwardProcess, ForwardProcessLoss, NFTLoss
    from agents.post_training.algorithms.guidance_distillation import GuidanceDistillation, GuidanceDistillationLoss
    from agents.post_training.discriminator import Discriminator
    from agents.post_training.guard import Guard
    from agents.post_training.policy import DenoisingPolicy, gradient_weights
    from agents.post_training.report import post_train_and_compare
    from agents.post_training.rollouts import collect
    from agents.post_training.settings import (
        AlgorithmSettings,
        DDPOSFSettings,
        PostTrainConfig,
        list_algorithms,
        register_algorithm,
    )
    from agents.post_training.trainer import PostTrainer, PostTrainResult, post_train

__all__ = [
    "DDPO",
    "AWMLoss",
    "Advantage",
    "Algorithm",
    "AlgorithmSettings",
    "DDPOSFLoss",
    "DDPOSFSettings",
    "DenoisingPolicy",
    "Discriminator",
    "ForwardProcess",
    "ForwardProcessLoss",
    "Guard",
    "GuidanceDistillation",
    "GuidanceDistillationLoss",
    "NFTLoss",
    "PostTrainConfig",
    "PostTrainResult",
    "PostTrainer",
    "collect",
    "compute_advantages",
    "gradient_weights",
    "list_algorithms",
    "post_train",
    "post_train_and_compare",
    "register_algorithm",
]

__getattr__ = lazy_names(__name__, __file__)
