"""Pretraining of scene priors on datasets or on a grammar."""

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from agents.pretraining.settings import PretrainConfig
    from agents.pretraining.trainer import Pretrainer, pretrain

__all__ = ["PretrainConfig", "Pretrainer", "pretrain"]

__getattr__ = lazy_names(__name__, __file__)
