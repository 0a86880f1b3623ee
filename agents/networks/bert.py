"""BERT as a text encoder of a mixed prior: frozen, read from disk, and not part of the prior's file.

The paper conditions its Flux model on BERT-base (Devlin et al. 2019; Pfaff et al., CoRL 2025). Here a prior is
conditioned on the last hidden states of BERT's tokens. The package ``transformers`` is imported when a prompt is first
read, never before.
"""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from agents.networks.bert_files import FOLDER_VARIABLE, Bert, download_bert, load_bert
from agents.networks.text import PADDING, split_words, warn_unknown
from scene_envs.errors import InvalidInputError

Row = tuple[int, ...]
"""The tokens of one prompt, without padding."""
CACHED_PROMPTS = 4096
"""Number of latest prompts whose hidden states are cached."""
_TOGETHER = 64
"""Prompts encoded together on an accelerator; on CPU each is encoded alone, so that no result depends on others."""


@dataclass(frozen=True)
class BertTextConfig:
    """Which BERT a prior reads prompts with.

    Attributes:
        model: folder with the model, or its name on the Hugging Face hub.
        width: of its tokens, 768 for BERT-base.
        digest: SHA-256 of its weights and vocabulary; another model is refused.
        size: of its vocabulary.
        nothing: its tokens of ``""``, start and end.
        max_tokens: longest prompt in its tokens, start and end included.
        kind: ``"bert"``, which tells the entry of a configuration file from that of another encoder.
    """

    model: str
    width: int
    digest: str
    size: int = 30522
    nothing: tuple[int, ...] = (101, 102)
    max_tokens: int = 512
    kind: str = "bert"

    @classmethod
    def from_model(cls, model: str | os.PathLike[str], *, download: bool = False) -> BertTextConfig:
        """The config of a model at hand.

        Args:
            model: folder with the model, or its name on the hub, which is looked for in the local cache.
            download: whether a hub model that is not in the cache is downloaded.

        Raises:
            MissingDependencyError: ``transformers`` is not installed.
            InvalidInputError: no such model at hand, or not a BERT.
        """
        name = os.path.abspath(model) if Path(model).is_dir() else str(model)
        if download:
            download_bert(name)
        bert = load_bert(name)
        nothing = tuple(bert.tokenizer("")["input_ids"])
        settings = bert.model.config
        return cls(
            name, settings.hidden_size, bert.digest, settings.vocab_size, nothing, settings.max_position_embeddings
        )


class BertEncoder(nn.Module):
    """Prompts to the last hidden states (B, L, W) of a frozen BERT.

    Its only own tensor is ``nothing`` (2, W), the hidden states of the empty prompt ``""``. A prior's file holds this
    tensor and not BERT, so that the prior can be sampled without prompts where BERT is not at hand. Copies of a prior
    share one BERT. The hidden states of the latest prompts are cached.

    Args:
        config: which BERT.
        cached: number of prompts whose hidden states are cached.
    """

    nothing: Tensor

    def __init__(self, config: BertTextConfig, cached: int = CACHED_PROMPTS) -> None:
        super().__init__()
        self.config = config
        self.cached = cached
        self._states: OrderedDict[Row, Tensor] = OrderedDict()
        self.register_buffer("nothing", torch.full((len(config.nothing), config.width), torch.nan))

    @property
    def token_space(self) -> tuple[int, int]:
        """Largest number of tokens in a prompt, and number of different tokens."""
        return self.config.max_tokens, self.config.size

    def tokenize(self, prompts: Sequence[str]) -> tuple[Tensor, list[str]]:
        """Token indices (B, L) int64, padded with 0 at the end, and the words for which BERT has no word pieces.

        Raises:
            MissingDependencyError: ``transformers`` is not installed.
            InvalidInputError: BERT is not at hand or is another model, or a prompt is too long.
        """
        if not any(prompts):
            return torch.tensor([self.config.nothing] * len(prompts)), []
        tokenizer = self._bert().tokenizer
        rows = tokenizer(list(prompts))["input_ids"]
        for prompt, row in zip(prompts, rows, strict=True):
            if len(row) > self.config.max_tokens:
                raise InvalidInputError(
                    f"the prompt {prompt[:60]!r}… has {len(row)} tokens; BERT reads at most {self.config.max_tokens}"
                )
        unknown = tokenizer.unk_token_id
        words = dict.fromkeys(w for p, row in zip(prompts, rows, strict=True) if unknown in row for w in split_words(p))
        strange = [word for word in words if unknown in tokenizer(word, add_special_tokens=False)["input_ids"]]
        return nn.utils.rnn.pad_sequence([torch.tensor(row) for row in rows], batch_first=True), strange

    def forward(self, prompts: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Tokens (B, L, W) and their mask (B, L), True for real ones; ``""`` stands for no prompt.

        Raises:
            MissingDependencyError, InvalidInputError: as :meth:`tokenize`.
        """
        indices, unknown = self.tokenize(prompts)
        warn_unknown(unknown)
        return self.encode(indices)

    def encode(self, indices: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens and mask as of :meth:`forward`, from token indices (B, L) int64 as :meth:`tokenize` gives them."""
        rows = [tuple(index for index in row if index != PADDING) for row in indices.tolist()]
        states = self._remembered(list(dict.fromkeys(rows)))
        padded = nn.utils.rnn.pad_sequence([states[row] for row in rows], batch_first=True)
        lengths = torch.tensor([len(row) for row in rows], device=padded.device)
        return padded, torch.arange(padded.shape[1], device=padded.device) < lengths[:, None]

    def _remembered(self, rows: list[Row]) -> dict[Row, Tensor]:
        """The hidden states (L, W) of each prompt; those that are not cached are computed, and cached."""
        found = {row: self._states[row] for row in rows if row in self._states}
        if self.config.nothing in rows:
            self._know_nothing()
            found[self.config.nothing] = self.nothing
        missing = [row for row in rows if row not in found]
        together = 1 if self.nothing.device.type == "cpu" else _TOGETHER
        for start in range(0, len(missing), together):
            some = missing[start : start + together]
            found.update(zip(some, self._hidden_states(some), strict=True))
        for row in rows:
            self._states[row] = found[row]
            self._states.move_to_end(row)
        while len(self._states) > self.cached:
            self._states.popitem(last=False)
        return found

    @torch.no_grad()
    def _hidden_states(self, rows: list[Row]) -> list[Tensor]:
        device = self.nothing.device
        indices = nn.utils.rnn.pad_sequence([torch.tensor(row) for row in rows], batch_first=True).to(device)
        with torch.autocast(device.type, enabled=False):
            states = self._bert().model(indices, attention_mask=(indices != PADDING).long()).last_hidden_state
        return [state[: len(row)].to(self.nothing.dtype) for state, row in zip(states, rows, strict=True)]

    def _bert(self) -> Bert:
        folder = os.environ.get(FOLDER_VARIABLE, "")
        bert = load_bert(folder or self.config.model, str(self.nothing.device))
        if bert.digest != self.config.digest:
            raise InvalidInputError(
                f"the model at {folder or self.config.model!r} is not the BERT that this prior was trained with: its "
                f"digest is {bert.digest[:12]}…, not {self.config.digest[:12]}…; name the folder of the right one in "
                f"{FOLDER_VARIABLE}"
            )
        return bert

    def _know_nothing(self) -> None:
        if bool(self.nothing.isnan().any()):
            self.nothing.copy_(self._hidden_states([self.config.nothing])[0])

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        self._know_nothing()
        super()._save_to_state_dict(destination, prefix, keep_vars)

    def _apply(self, fn: Any, recurse: bool = True) -> BertEncoder:
        self._states.clear()  # the cached states are on the former device
        super()._apply(fn, recurse)
        return self
