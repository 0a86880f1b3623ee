"""Scene priors: trained denoisers that sample, complete and rearrange scenes."""

from agents.configuration.prior_names import list_priors
from agents.priors.base import ScenePrior
from agents.priors.checkpoint_import import import_checkpoint
from agents.priors.config import MixedPriorConfig, PriorConfig
from agents.priors.continuous import ContinuousPrior
from agents.priors.mixed import MixedPrior

__all__ = [
    "ContinuousPrior",
    "MixedPrior",
    "MixedPriorConfig",
    "PriorConfig",
    "ScenePrior",
    "import_checkpoint",
    "list_priors",
]
