"""Priors, post-training, planning, evaluation and the command line.

The names below load their modules, and torch with them, when they are first used.

>>> from agents import ScenePrior, run_search
>>> ScenePrior.__name__, run_search.__name__
('ScenePrior', 'run_search')
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from agents.evaluation import evaluate
    from agents.planning import SearchConfig, SearchOutcome, run_search
    from agents.post_training import PostTrainConfig, PostTrainResult, post_train
    from agents.pretraining import PretrainConfig, pretrain
    from agents.priors import ScenePrior, list_priors

__all__ = [
    "PostTrainConfig",
    "PostTrainResult",
    "PretrainConfig",
    "ScenePrior",
    "SearchConfig",
    "SearchOutcome",
    "evaluate",
    "list_priors",
    "post_train",
    "pretrain",
    "run_search",
]

__getattr__ = lazy_names(__name__, __file__)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
