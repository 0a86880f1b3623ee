"""Text of a prior: prompts as tokens that its network attends to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from agents.networks.count_conditioning import CountConditioning
from agents.networks.text import PADDING, Text, TextEncoder, vocabulary, warn_unknown
from agents.priors.prompt_validation import check_object_count, no_text
from scene_envs.datasets.prompts.facts import SIDES
from scene_envs.datasets.prompts.language import NUMBERS, ORDINALS, SIDE_PHRASES, Nouns
from scene_envs.scene_types import SceneType


class PromptReader:
    """The part of a prior that turns prompts into tokens of its network.

    A prompt becomes token indices (``read_prompts``), which an environment can show, and these become tokens of the
    network (``encode_tokens``). ``""`` stands for no prompt.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior(process="mixed", text=True)
    >>> indices = prior.read_prompts(["A scene with two cups.", ""], slots=34)
    >>> indices.shape, (indices != 0).sum(dim=1).tolist()
    (torch.Size([2, 128]), [7, 1])
    >>> tokens, mask = prior.encode_tokens(indices)
    >>> tokens.shape, mask.shape
    (torch.Size([2, 4, 16]), torch.Size([2, 4]))
    """

    denoiser: Any
    scene_type: SceneType

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""
        return self.denoiser.text_encoder is not None

    @property
    def prompt_space(self) -> tuple[int, int]:
        """Largest number of tokens of a prompt, and size of the vocabulary; 0 is padding."""
        return self._encoder("").token_space

    def read_prompts(self, prompts: Sequence[str], slots: int) -> Tensor:
        """Token indices (B, L) int64 on the CPU, padded to the length of the longest possible prompt.

        Unknown words are listed in a warning.

        Raises:
            InvalidInputError: the prior reads no prompts, a prompt is too long, or one asks for more objects than
                ``slots``.
        """
        encoder = self._encoder(prompts[0])
        check_object_count(prompts, self.scene_type, slots)
        indices, unknown = encoder.tokenize(prompts)
        warn_unknown(unknown)
        longest = encoder.token_space[0]
        return torch.nn.functional.pad(indices, (0, longest - indices.shape[1]), value=PADDING)

    def encode_tokens(self, indices: Tensor) -> Text:
        """Tokens (B, L', W) and mask (B, L') of token indices (B, L); equal rows are encoded once."""
        used = (indices != PADDING).any(dim=0)
        rows, place = torch.unique(indices[:, used].cpu(), dim=0, return_inverse=True)
        tokens, mask = self._encoder("").encode(rows)
        place = place.to(tokens.device)
        return tokens[place], mask[place]

    def encode_prompts(self, prompts: Sequence[str]) -> Text:
        """Tokens (B, L, W) and mask (B, L) of prompts; equal prompts are encoded once.

        Raises:
            InvalidInputError: the prior reads no prompts, or one is too long.
        """
        different = list(dict.fromkeys(prompts))
        tokens, mask = self._encoder(different[0])(different)
        place = torch.tensor([different.index(prompt) for prompt in prompts], device=tokens.device)
        return tokens[place], mask[place]

    def unconditional(self, count: int) -> Text | None:
        """Text of the empty prompt; None for a prior without text."""
        if not self.conditional:
            return None
        tokens, mask = self.encode_prompts([""])
        return tokens.expand(count, -1, -1), mask.expand(count, -1)

    def warn_unknown_words(self, prompts: Iterable[str]) -> None:
        """Warn of words in ``prompts`` that the vocabulary of the prior lacks."""
        if isinstance(self.denoiser.text_encoder, TextEncoder):
            warn_unknown(self.denoiser.text_encoder.unknown_words(prompts))

    @property
    def count_conditioning(self) -> CountConditioning | None:
        """The part of the network that reads how many objects a prompt asks for; None if there is none."""
        return getattr(self.denoiser.network, "count_conditioning", None) if self.conditional else None

    def freeze_text(self) -> None:
        """Freeze the text encoder, if there is one: training does not change it from then on."""
        if self.conditional:
            self.denoiser.text_encoder.requires_grad_(False)

    def _encoder(self, prompt: str) -> Any:
        if self.denoiser.text_encoder is None:
            raise no_text(self.scene_type, prompt)
        return self.denoiser.text_encoder


def prompt_words(scene_type: SceneType) -> tuple[str, ...]:
    """The words of all prompts that can be written about scenes of a type, sorted, with the numbers up to 130.

    >>> from scene_envs.scene_types import get_scene_type
    >>> {"teapot", "cups", "behind", "17"} <= set(prompt_words(get_scene_type("dimsum_table")))
    True
    """
    names = Nouns(scene_type).plural
    frame = "A scene with where, and is are each an on in top of the same shelf tier from bottom object objects."
    return vocabulary([frame, *NUMBERS, *ORDINALS, *SIDES, *SIDE_PHRASES.values(), *names, *names.values()])
