"""Frozen set encoder: features of scenes of any type for the Fréchet scene distance."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path

import torch
from torch import Tensor, nn

from agents.evaluation.set_network import WAVE_FEATURES, SceneTokens, SetNetwork, SetNetworkConfig, scene_tokens
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.files import read_tensors, write_tensors
from scene_envs.scene import SceneBatch

SHIPPED = Path(__file__).parent / "weights" / "set_encoder.safetensors"
"""File of the encoder that :func:`~agents.evaluation.pictures.frechet_scene_distance` uses."""

FEATURES = 64
"""Number of features of a scene."""

_OWN = 12 + WAVE_FEATURES + 3
_CHUNK = 256


class SetEncoder(nn.Module):
    """Encoder of scenes of any type to 64 features; invariant to the order of slots and to empty slots.

    Categories are read by asset name, so that a scene has the same features in a union of types as in its own type. An
    asset outside the vocabulary becomes the *unknown* asset, of which the encoder reads the bounding box but no name.
    Distances between scenes of users' own assets depend on sizes, poses and gaps, and not on names.

    Args:
        vocabulary: names of the known assets.
        config: sizes of the network; None takes those of the shipped one.

    >>> encoder = SetEncoder(("cafe_table", "teacup")).eval()
    >>> encoder.features(SceneBatch.empty("dimsum_table", 2)).shape
    torch.Size([2, 64])
    """

    def __init__(self, vocabulary: Sequence[str], config: SetNetworkConfig | None = None) -> None:
        super().__init__()
        self.vocabulary = tuple(vocabulary)
        self.config = config or SetNetworkConfig(
            _OWN, len(self.vocabulary) + 2, FEATURES, hidden=64, heads=2, blocks=1, dropout=0.0
        )
        self.network = SetNetwork(self.config)
        self.mean: Tensor
        self.whitening: Tensor
        self.register_buffer("mean", torch.zeros(self.config.outputs))
        self.register_buffer("whitening", torch.eye(self.config.outputs))

    @property
    def unknown(self) -> int:
        """Token of an asset outside the vocabulary."""
        return len(self.vocabulary)

    def names(self, batch: SceneBatch) -> Tensor:
        """(C + 1,) int64: the token of each category of the batch's scene type, empty last."""
        index = {name: token for token, name in enumerate(self.vocabulary)}
        tokens = [index.get(name, self.unknown) for name in batch.scene_type.assets]
        return torch.tensor([*tokens, self.unknown + 1])

    def forward(self, tokens: SceneTokens, names: Tensor) -> Tensor:
        """Features (B, F) before whitening; ``names`` (C + 1,) gives the token of each category."""
        size = (tokens.extents.clamp(min=1e-3) / 0.1).log() * tokens.present[..., None]
        own = torch.cat([tokens.poses, tokens.waves, size], dim=-1)
        return self.network(own, names[tokens.categories], tokens.offsets, names[tokens.neighbours], tokens.present)

    @torch.no_grad()
    def features(self, batch: SceneBatch) -> Tensor:
        """(B, F) float32 whitened features, on the CPU."""
        was_training = self.training
        self.eval()
        names = self.names(batch)
        parts = [batch[start : start + _CHUNK].to("cpu") for start in range(0, len(batch), _CHUNK)]
        raw = torch.cat([self(scene_tokens(part), names) for part in parts]) if parts else torch.empty(0, FEATURES)
        self.train(was_training)
        return (raw - self.mean) @ self.whitening

    def save(self, path: str | os.PathLike[str], note: str = "") -> Path:
        """Write weights (float16; mean and whitening float32), vocabulary and size to one ``.safetensors`` file.

        Args:
            path: file to write.
            note: a sentence on how the encoder was trained, kept in the file.
        """
        weights = {name: value.detach().contiguous() for name, value in self.state_dict().items()}
        weights = {name: value.half() if name.startswith("network.") else value for name, value in weights.items()}
        metadata = {"vocabulary": json.dumps(self.vocabulary), "config": json.dumps(asdict(self.config)), "note": note}
        return write_tensors(path, weights, metadata)

    @classmethod
    def load(cls, path: str | os.PathLike[str] | None = None) -> SetEncoder:
        """The encoder in ``path``, frozen and in evaluation mode; None takes the shipped one.

        Raises:
            InvalidInputError: the file does not exist.
            CorruptFileError: the file was not written by :meth:`save`.
        """
        return _load(str(SHIPPED if path is None else Path(path).resolve()))


@cache
def _load(path: str) -> SetEncoder:
    try:
        weights, metadata = read_tensors(path)
        encoder = SetEncoder(json.loads(metadata["vocabulary"]), SetNetworkConfig(**json.loads(metadata["config"])))
        encoder.load_state_dict({name: value.float() for name, value in weights.items()})
    except FileNotFoundError:
        raise InvalidInputError(f"no set encoder at {path!r}; train_set_encoder makes one") from None
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CorruptFileError(f"{path!r} is not a set encoder written by SetEncoder.save: {error}") from error
    return encoder.eval().requires_grad_(False)
