"""DDPO whose advantages are signs."""

from dataclasses import dataclass

from agents.post_training import DDPO, register_algorithm
from agents.post_training.algorithms import DDPOSFSettings


@dataclass
class SignSettings(DDPOSFSettings):
    """DDPO-SF with advantages of one size.

    Attributes:
        size: of every advantage.
    """

    name: str = "signs"
    size: float = 1.0


@register_algorithm("signs", SignSettings)
class Signs(DDPO):
    """Advantages of plus and minus ``size``."""

    def advantage(self, rollout):
        return self.settings.size * super().advantage(rollout).sign()
