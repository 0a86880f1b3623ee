"""Text encoders of mixed priors: BERT, and the choice between it and the small encoder of :mod:`agents.networks.text`.

The paper conditions its Flux model on BERT-base (Devlin et al. 2019; Pfaff et al., CoRL 2025). Here a prior is
conditioned on the last hidden states of BERT's tokens. BERT is frozen, read from a folder or the local cache of the
Hugging Face hub, loaded once, identified by a digest, and not part of the prior's file. The package ``transformers`` is
imported when a prompt is first read, never before.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from torch import Tensor, nn

from agents.networks.text import PADDING, TextConfig, TextEncoder, split_words, vocabulary, warn_unknown
from scene_envs.errors import InvalidInputError, MissingDependencyError

_LOGGER = logging.getLogger(__name__)

BERT_BASE = "google-bert/bert-base-uncased"
"""Name of BERT-base on the Hugging Face hub."""
FOLDER_VARIABLE = "SCENE_ENVS_BERT"
"""Environment variable that names the folder of the BERT model, for priors trained with it elsewhere."""
_HUB_NAME = re.compile(r"[\w.-]+(/[\w.-]+)?")


class Bert(NamedTuple):
    """A loaded model: a frozen ``transformers.BertModel``, its tokenizer, and the digest of weights and vocabulary."""

    model: Any
    tokenizer: Any
    digest: str


@lru_cache(maxsize=4)
def load_bert(model: str, device: str = "cpu") -> Bert:
    """The frozen model in the folder ``model``, or of that name on the hub and in the local cache, loaded once per
    process and device; only local files are read.

    Raises:
        MissingDependencyError: ``transformers`` is not installed.
        InvalidInputError: no such model at hand, or not a BERT.
    """
    kinds = _transformers()
    try:
        with _quiet(kinds):
            kind = kinds.AutoConfig.from_pretrained(model, local_files_only=True).model_type
            if kind != "bert":
                raise InvalidInputError(f"the text encoder {model!r} is a {kind!r} model, not a BERT")
            tokenizer = kinds.AutoTokenizer.from_pretrained(model, local_files_only=True)
            network, report = kinds.BertModel.from_pretrained(
                model, local_files_only=True, add_pooling_layer=False, output_loading_info=True
            )
    except InvalidInputError:
        raise
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        raise InvalidInputError(_not_at_hand(model, error)) from error
    if tokenizer.pad_token_id != PADDING:
        raise InvalidInputError(f"the vocabulary of {model!r} does not begin with its padding token, as BERT's do")
    if report["missing_keys"]:
        missing = ", ".join(sorted(report["missing_keys"])[:4])
        raise InvalidInputError(f"the BERT at {model!r} lacks weights: {missing}; fetch the model again")
    network = network.float().eval().requires_grad_(False)
    return Bert(network.to(device), tokenizer, _digest(network, tokenizer))


@contextmanager
def _quiet(kinds: Any) -> Iterator[None]:
    """Silence the library's reports and progress bars; :func:`load_bert` reports errors itself."""
    library, verbosity = kinds.utils.logging, kinds.utils.logging.get_verbosity()
    bars = library.is_progress_bar_enabled()
    library.set_verbosity_error()
    library.disable_progress_bar()
    try:
        yield
    finally:
        library.set_verbosity(verbosity)
        if bars:
            library.enable_progress_bar()


def _transformers() -> Any:
    try:
        import transformers
    except ImportError as error:
        raise MissingDependencyError(
            "prompts of this prior are read by BERT, which needs the package transformers: pip install "
            "'scene-envs[bert]'; without it, sample without a prompt"
        ) from error
    return transformers


def _not_at_hand(model: str, error: Exception) -> str:
    if os.path.isdir(model):
        return (
            f"the folder {model!r} holds no BERT that transformers can read ({_first_line(error)}); it needs "
            "config.json, the tokenizer's files and model.safetensors, as save_pretrained writes them"
        )
    return (
        f"the BERT model {model!r} is neither a folder nor in the local cache of the Hugging Face hub; fetch it with "
        f"'hf download {model if _HUB_NAME.fullmatch(model) else BERT_BASE}', or name a folder that holds one, as text "
        f"encoder or in {FOLDER_VARIABLE}"
    )


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].strip().rstrip(".")


def _digest(model: nn.Module, tokenizer: Any) -> str:
    """SHA-256 of the weights (float32, by name) and of the vocabulary."""
    digest = hashlib.sha256()
    for name, weight in sorted(model.named_parameters()):
        digest.update(f"{name} {tuple(weight.shape)}\n".encode())
        digest.update(weight.detach().cpu().contiguous().numpy().tobytes())
    for word, index in sorted(tokenizer.get_vocab().items()):
        digest.update(f"{word}\t{index}\n".encode())
    return digest.hexdigest()


Row = tuple[int, ...]
"""The tokens of one prompt, without padding."""
_TOGETHER = 64
"""Prompts encoded together on an accelerator; on CPU each is encoded alone, so that no result depends on others."""


@dataclass(frozen=True)
class BertTextConfig:
    """Which BERT a prior reads prompts with.

    Attributes:
        model: folder with the model, or its name on the Hugging Face hub.
        width: width of its tokens, 768 for BERT-base.
        digest: SHA-256 of its weights and vocabulary; another model is refused.
        size: size of its vocabulary.
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
        """The config of the model that :func:`load_bert` finds; ``download`` first fetches a hub model that is not in
        the local cache. Errors as for :func:`load_bert`.
        """
        name = os.path.abspath(model) if Path(model).is_dir() else str(model)
        if download and not os.path.isdir(name):
            _transformers()
            from huggingface_hub import snapshot_download

            try:
                snapshot_download(name, allow_patterns=["*.json", "vocab.txt", "model.safetensors"])
            except Exception as error:
                _LOGGER.info(
                    "%s could not be downloaded (%s); the local cache is looked into", name, _first_line(error)
                )
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
    share one BERT.

    Args:
        config: configuration that names the BERT.
        cached: number of latest prompts whose hidden states are cached.
    """

    nothing: Tensor

    def __init__(self, config: BertTextConfig, cached: int = 4096) -> None:
        super().__init__()
        self.config = config
        self.cached = cached
        self._states: dict[Row, Tensor] = {}
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
        """Tokens (B, L, W) and their mask (B, L), True for real ones; ``""`` stands for no prompt. Errors as for
        :meth:`tokenize`.
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
        found = {row: self._states.pop(row) for row in rows if row in self._states}  # and become the latest again
        if self.config.nothing in rows:
            self._know_nothing()
            found[self.config.nothing] = self.nothing
        missing = [row for row in rows if row not in found]
        together = 1 if self.nothing.device.type == "cpu" else _TOGETHER
        for start in range(0, len(missing), together):
            some = missing[start : start + together]
            found.update(zip(some, self._hidden_states(some), strict=True))
        self._states = dict([*self._states.items(), *found.items()][-self.cached :])
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
    """The configuration that a run's key ``text.encoder`` asks for: ``"vocabulary"``, a closed one of ``prompts``, or
    the folder or hub name of a BERT model, with arguments and errors of :meth:`BertTextConfig.from_model`.
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
