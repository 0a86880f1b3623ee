"""Post-training of a prior by reinforcement learning, with regularisation on real scenes."""

from typing import TYPE_CHECKING

from scene_envs.lazy import lazy_names

if TYPE_CHECKING:
    from agents.post_training.advantages import compute_advantages
    from agents.post_training.algorithm_settings import AlgorithmSettings, DDPOSFSettings
    from agents.post_training.algorithms import list_algorithms, register_algorithm
    from agents.post_training.base import Algorithm
    from agents.post_training.comparison_run import post_train_and_compare
    from agents.post_training.config import PostTrainConfig
    from agents.post_training.ddpo import DDPO
    from agents.post_training.discriminator import Discriminator
    from agents.post_training.forward_losses import AWMLoss, NFTLoss
    from agents.post_training.forward_process import ForwardProcess
    from agents.post_training.forward_process_loss import ForwardProcessLoss
    from agents.post_training.guard import Guard
    from agents.post_training.guidance_distillation import GuidanceDistillation, GuidanceDistillationLoss
    from agents.post_training.losses import DDPOSFLoss
    from agents.post_training.policy import DenoisingPolicy
    from agents.post_training.trainer import PostTrainer, PostTrainResult, post_train

__all__ = [
    "DDPO",
    "AWMLoss",
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
    "compute_advantages",
    "list_algorithms",
    "post_train",
    "post_train_and_compare",
    "register_algorithm",
]

__getattr__ = lazy_names(__name__, __file__)
