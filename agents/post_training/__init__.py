"""Post-training of a prior by reinforcement learning: DDPO-SF with regularisation on real scenes."""

from agents.post_training.advantages import compute_advantages
from agents.post_training.config import PostTrainConfig
from agents.post_training.guard import Guard, GuardReading
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.policy import DenoisingPolicy, gradient_weights
from agents.post_training.steering import steer
from agents.post_training.trainer import PostTrainer, PostTrainResult, post_train

__all__ = [
    "DDPOSFLoss",
    "DenoisingPolicy",
    "Guard",
    "GuardReading",
    "PostTrainConfig",
    "PostTrainResult",
    "PostTrainer",
    "compute_advantages",
    "gradient_weights",
    "post_train",
    "steer",
]
