"""Post-training of a prior by reinforcement learning: DDPO-SF with regularisation on real scenes."""

from agents.post_training.advantages import compute_advantages
from agents.post_training.comparison_run import post_train_and_compare
from agents.post_training.config import PostTrainConfig
from agents.post_training.guard import Guard
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.trainer import PostTrainer, PostTrainResult, post_train

__all__ = [
    "DDPOSFLoss",
    "DenoisingPolicy",
    "Guard",
    "PostTrainConfig",
    "PostTrainResult",
    "PostTrainer",
    "compute_advantages",
    "post_train",
    "post_train_and_compare",
]
