"""Choice of the text encoder of a mixed prior: by configuration, by the entry of a file, by the key of a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from agents.networks.bert import BertEncoder, BertTextConfig
from agents.networks.text import TextConfig, TextEncoder, vocabulary

VOCABULARY = "vocabulary"
"""The key of the small encoder with a closed vocabulary, trained with the prior."""

AnyTextConfig = TextConfig | BertTextConfig
"""Configurations of text encoders."""


def text_encoder(config: AnyTextConfig) -> TextEncoder | BertEncoder:
    """A text encoder: prompts to tokens (B, L, W) and their mask (B, L).

    >>> text_encoder(TextConfig(words=("cup",), width=8, heads=2))(["cup"])[0].shape
    torch.Size([1, 16, 8])
    """
    return BertEncoder(config) if isinstance(config, BertTextConfig) else TextEncoder(config)


def text_config(key: str, prompts: Iterable[str]) -> AnyTextConfig:
    """The configuration that a run's key ``text_encoder`` asks for.

    Args:
        key: ``"vocabulary"``, or the folder or hub name of a BERT model. A hub model that is not in the local cache is
            downloaded.
        prompts: all prompts of the training data, from which a closed vocabulary is made.

    Raises:
        MissingDependencyError: ``transformers`` is not installed.
        InvalidInputError: no such BERT at hand.
    """
    if key == VOCABULARY:
        return TextConfig(vocabulary(prompts))
    return BertTextConfig.from_model(key, download=True)


def text_config_from_state(fields: Mapping[str, Any] | None) -> AnyTextConfig | None:
    """Inverse of :func:`dataclasses.asdict`, also after a trip through JSON; None stays None.

    >>> text_config_from_state({"words": ["cup"], "width": 8}).width
    8
    """
    if fields is None:
        return None
    if fields.get("kind") == "bert":
        return BertTextConfig(**{**fields, "nothing": tuple(fields["nothing"])})
    return TextConfig(**{**fields, "words": tuple(fields["words"])})
