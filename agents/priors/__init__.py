"""Scene priors: trained denoisers that sample, complete and rearrange scenes."""

from agents.configuration.prior_names import list_priors
from agents.priors.checkpoint_import import import_checkpoint
from agents.priors.config import DenoiserConfig, MixedPriorConfig, PoseDiffusionConfig, PriorConfig
from agents.priors.continuous import ContinuousPrior
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior

__all__ = [
    "ContinuousPrior",
    "DenoiserConfig",
    "MixedPrior",
    "MixedPriorConfig",
    "PoseDiffusionConfig",
    "PriorConfig",
    "ScenePrior",
    "import_checkpoint",
    "list_priors",
]
