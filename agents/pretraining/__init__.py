"""Pretraining of scene priors on datasets or on a grammar."""

from agents.pretraining.config import PretrainConfig
from agents.pretraining.trainer import Pretrainer, pretrain

__all__ = ["PretrainConfig", "Pretrainer", "pretrain"]
