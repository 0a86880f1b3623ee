"""A small text encoder with a closed vocabulary, trained together with the prior that reads it."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from scene_envs.datasets.prompts.parser import NUMBERS
from scene_envs.errors import InvalidInputError

_LOGGER = logging.getLogger(__name__)

_TOKEN = re.compile(r"[a-z]+|\d+|[^\sa-z\d]")

Text = tuple[Tensor, Tensor]
"""Tokens (B, L, W) and their mask (B, L), False on padding."""

PADDING, UNKNOWN, START = 0, 1, 2
"""The first tokens: padding, a word outside the vocabulary, and the start of every prompt."""
_SPECIAL = 3
_PERIODS = (4, 16, 64)
_CHUNKS = 4
"""Parts of a batch of prompts on the CPU, each as wide as its longest prompt."""


def split_words(prompt: str) -> list[str]:
    """Lower-case words, numbers and punctuation marks.

    >>> split_words("A scene with 12 cups, and a lid.")
    ['a', 'scene', 'with', '12', 'cups', ',', 'and', 'a', 'lid', '.']
    """
    return _TOKEN.findall(prompt.lower())


def number_features(word: str) -> list[float]:
    """Features of a number word: 1, n/16, log(1 + n), and sines and cosines of n; zeros for other words.

    Embeddings alone would have to learn the value of each number separately. Articles stand for 1.

    >>> number_features("three")[:3] == number_features("3")[:3] == [1.0, 3 / 16, math.log(4)]
    True
    >>> sum(map(abs, number_features("cups")))
    0.0
    """
    if word.isdigit():
        number = int(word)
    elif word in ("a", "an"):
        number = 1
    elif word in NUMBERS:
        number = NUMBERS.index(word)
    else:
        return [0.0] * (3 + 2 * len(_PERIODS))
    angles = [2 * math.pi * number / period for period in _PERIODS]
    return [1.0, number / 16, math.log1p(number), *map(math.sin, angles), *map(math.cos, angles)]


@dataclass(frozen=True)
class TextConfig:
    """Size and vocabulary of a :class:`TextEncoder`.

    Attributes:
        words: the vocabulary, sorted; tokens are its indices after three special ones.
        width: width of the tokens.
        depth: transformer layers.
        heads: attention heads.
        max_tokens: longest prompt, its start token included.
        latents: tokens that a prompt is condensed to, so that long ones cost no more than short ones.
        window: neighbouring words that are read together before attention ("two tea bottles"), an odd number.
        count_tokens: leading tokens, one for each kind of object and one for all objects, for count conditioning.
        numbers: whether words that are numbers say how many they are (:func:`number_features`).
    """

    words: tuple[str, ...]
    width: int = 128
    depth: int = 2
    heads: int = 4
    max_tokens: int = 128
    latents: int = 16
    window: int = 1
    count_tokens: int = 0
    numbers: bool = False

    def __post_init__(self) -> None:
        if self.latents < 1:
            raise InvalidInputError(f"a text encoder with latents={self.latents} gives no tokens; give at least 1")
        if self.window < 1 or self.window % 2 == 0:
            raise InvalidInputError(f"a text window of {self.window} words: give an odd number, 1 for single words")


def vocabulary(prompts: Iterable[str]) -> tuple[str, ...]:
    """All words of ``prompts`` and the numbers 0 to 130, which are for counts, sorted."""
    words = {word for prompt in prompts for word in split_words(prompt)}
    return tuple(sorted(words | {str(number) for number in range(131)}))


class TextEncoder(nn.Module):
    """Prompts to tokens (B, L, W): learned embeddings and positions, a small transformer, and a few learned queries.

    The queries (``latents``) attend to the words, as in the Perceiver's first layer (Jaegle et al. 2021).

    >>> encoder = TextEncoder(TextConfig(words=("cup", "two", "cups"), width=16, heads=2, latents=4))
    >>> tokens, mask = encoder(["two cups", ""])
    >>> tokens.shape, bool(mask.all())
    (torch.Size([2, 4, 16]), True)
    """

    def __init__(self, config: TextConfig) -> None:
        super().__init__()
        self.config = config
        self._index = {word: index + _SPECIAL for index, word in enumerate(config.words)}
        self.embedding = nn.Embedding(len(config.words) + _SPECIAL, config.width)
        features = torch.tensor([number_features(word) for word in [""] * _SPECIAL + [*config.words]])
        self.number_table: Tensor
        self.register_buffer("number_table", features, persistent=False)
        self.number_in = nn.Linear(features.shape[1], config.width, bias=False) if config.numbers else None
        self.position = nn.Parameter(0.02 * torch.randn(config.max_tokens, config.width))
        self.phrases = (
            nn.Conv1d(config.width, config.width, config.window, padding="same") if config.window > 1 else None
        )
        layer = nn.TransformerEncoderLayer(
            config.width, config.heads, 4 * config.width, dropout=0.0, activation="gelu", batch_first=True,
            norm_first=True,
        )  # fmt: skip
        self.layers = nn.TransformerEncoder(layer, config.depth, enable_nested_tensor=False)
        self.norm = nn.LayerNorm(config.width)
        self.questions = nn.Parameter(0.2 * torch.randn(config.count_tokens + config.latents, config.width))
        self.condense = nn.MultiheadAttention(config.width, config.heads, batch_first=True)
        self.answer_norm = nn.LayerNorm(config.width)

    @property
    def token_space(self) -> tuple[int, int]:
        """Largest number of tokens in a prompt, and number of different tokens."""
        return self.config.max_tokens, len(self.config.words) + _SPECIAL

    def tokenize(self, prompts: Sequence[str]) -> tuple[Tensor, list[str]]:
        """Token indices (B, L) int64, padded at the end, and the words that the vocabulary lacks.

        Raises:
            InvalidInputError: a prompt is longer than ``max_tokens``.
        """
        rows: list[list[int]] = []
        unknown: list[str] = []
        for prompt in prompts:
            words = split_words(prompt)
            unknown += [word for word in words if word not in self._index and word not in unknown]
            rows.append([START, *(self._index.get(word, UNKNOWN) for word in words)])
            if len(rows[-1]) > self.config.max_tokens:
                raise InvalidInputError(
                    f"the prompt {prompt[:60]!r}… has {len(words)} words; at most {self.config.max_tokens - 1} are read"
                )
        return nn.utils.rnn.pad_sequence([torch.tensor(row) for row in rows], True, PADDING), unknown

    def unknown_words(self, prompts: Iterable[str]) -> list[str]:
        """Words of ``prompts`` that the vocabulary lacks, sorted.

        >>> TextEncoder(TextConfig(words=("a", "cup"), width=8, heads=2)).unknown_words(["A cup.", "a jug"])
        ['.', 'jug']
        """
        return sorted({word for prompt in prompts for word in split_words(prompt)} - self._index.keys())

    def forward(self, prompts: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Tokens (B, L, W) and their mask (B, L), True for real ones; ``""`` stands for no prompt.

        Words outside the vocabulary are listed in a warning and read as unknown.
        """
        indices, unknown = self.tokenize(prompts)
        warn_unknown(unknown)
        return self.encode(indices)

    def encode(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens and mask as of :meth:`forward`, from token indices (B, L) int64 as :meth:`tokenize` gives them."""
        indices = indices.to(self.position.device)
        if len(indices) < 4 * _CHUNKS or indices.device.type != "cpu":
            return self._encode(indices)
        lengths = (indices != PADDING).sum(dim=1)  # in parts of similar length: few prompts are as long as the longest
        order = torch.argsort(lengths, stable=True)
        parts = [self._encode(indices[rows, : int(lengths[rows].max())]) for rows in order.tensor_split(_CHUNKS)]
        back = torch.argsort(order)
        tokens, mask = (torch.cat(side)[back] for side in zip(*parts, strict=True))
        return tokens, mask

    def _encode(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        mask = indices != PADDING
        x = self.embedding(indices)
        if self.number_in is not None:
            x = x + self.number_in(self.number_table[indices])
        if self.phrases is not None:
            words = (x * mask[..., None]).transpose(1, 2)
            x = x + self.phrases(words).transpose(1, 2)
        x = x + self.position[: indices.shape[1]]
        x = self.norm(self.layers(x, src_key_padding_mask=~mask))
        queries = self.questions.expand(len(indices), -1, -1)
        answers, _ = self.condense(queries, x, x, key_padding_mask=~mask, need_weights=False)
        return self.answer_norm(answers + queries), mask.new_ones(answers.shape[:2])


def warn_unknown(words: Sequence[str]) -> None:
    """Say which words of a prompt the vocabulary lacks."""
    if words:
        _LOGGER.warning("the prior does not know the word(s) %s; they are read as unknown", ", ".join(words))
