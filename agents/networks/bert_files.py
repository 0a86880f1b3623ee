"""BERT models from a folder or the local cache of the Hugging Face hub, loaded once and identified by a digest."""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from safetensors import SafetensorError
from torch import nn

from agents.networks.text import PADDING
from scene_envs.errors import InvalidInputError, MissingDependencyError

_LOGGER = logging.getLogger(__name__)

BASE = "google-bert/bert-base-uncased"
"""Name of BERT-base on the Hugging Face hub."""
FOLDER_VARIABLE = "SCENE_ENVS_BERT"
"""Environment variable that names the folder of the BERT model, for priors trained with it elsewhere."""
_HUB_NAME = re.compile(r"[\w.-]+(/[\w.-]+)?")


@dataclass(frozen=True, eq=False)
class Bert:
    """A loaded model.

    Attributes:
        model: ``transformers.BertModel``, frozen.
        tokenizer: its tokenizer.
        digest: SHA-256 of weights and vocabulary.
    """

    model: Any
    tokenizer: Any
    digest: str


@lru_cache(maxsize=4)
def load_bert(model: str, device: str = "cpu") -> Bert:
    """The frozen model at ``model``, loaded once per process and device; only local files are read.

    Args:
        model: folder, or name on the hub of a model in the local cache.
        device: torch device.

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


def download_bert(model: str) -> None:
    """Fetch a hub model into the local cache, unless it is there or ``model`` is a folder."""
    _transformers()
    from huggingface_hub import snapshot_download

    if os.path.isdir(model):
        return
    try:
        snapshot_download(model, allow_patterns=["*.json", "vocab.txt", "model.safetensors"])
    except Exception as error:
        _LOGGER.info("%s could not be downloaded (%s); the local cache is looked into", model, _first_line(error))


def _not_at_hand(model: str, error: Exception) -> str:
    if os.path.isdir(model):
        return (
            f"the folder {model!r} holds no BERT that transformers can read ({_first_line(error)}); it needs "
            "config.json, the tokenizer's files and model.safetensors, as save_pretrained writes them"
        )
    return (
        f"the BERT model {model!r} is neither a folder nor in the local cache of the Hugging Face hub; fetch it with "
        f"'hf download {model if _HUB_NAME.fullmatch(model) else BASE}', or name a folder that holds one, as text "
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
