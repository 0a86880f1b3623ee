"""Fréchet Inception distance of renders, for users who have the weights of an Inception-v3."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from agents.evaluation.frechet import feature_distance
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError
from scene_envs.scene import SceneBatch
from scene_envs.tensor_files import read_tensors

_SIDE = 299
_FID_CLASSES = 1008
"""Classes of the TensorFlow network of 2015, with which FIDs are computed; torchvision's own network has 1000."""


def frechet_inception_distance(
    a: SceneBatch,
    b: SceneBatch,
    weights: str | os.PathLike[str],
    *,
    width: int = 320,
    height: int = 240,
    batch_size: int = 16,
) -> float:
    """FID of semantic renders: the Fréchet distance of the pooled features of an Inception-v3.

    Nothing is downloaded. The weights are a state dict of torchvision's ``inception_v3`` (1000 classes) or of the
    port of the 2015 TensorFlow network that the ``pytorch-fid`` project publishes (1008 classes). Published FIDs are
    computed with the latter. A fit of 2048 features needs thousands of scenes; use equal numbers in ``a`` and ``b``.

    Args:
        a: scenes.
        b: scenes, ideally as many as in ``a``.
        weights: path of the state dict.
        width: width of the renders in pixels; they are then scaled to 299 x 299.
        height: height of the renders in pixels.
        batch_size: number of images per forward pass.

    Returns:
        The distance, at least 0.

    Raises:
        MissingDependencyError: torchvision or PyBullet is not installed.
        InvalidInputError: the file does not exist, or a batch has fewer than two scenes.
        CorruptFileError: the file is not a state dict of such a network.
    """
    network = load_inception(weights)
    features = [_features(network, batch, width, height, batch_size) for batch in (a, b)]
    return feature_distance(*features)


def load_inception(weights: str | os.PathLike[str]) -> nn.Module:
    """An Inception-v3 that gives its 2048 pooled features for images (B, 3, 299, 299) in -1 … 1.

    Arguments and errors as for :func:`frechet_inception_distance`.
    """
    path = Path(weights)
    if not path.is_file():
        raise InvalidInputError(f"no Inception-v3 weights at {str(path)!r}; give the path of a state dict")
    try:
        from torchvision.models.inception import Inception3
    except ImportError as error:
        raise MissingDependencyError(
            "a Fréchet Inception distance needs torchvision, which is not installed; install the version that "
            "belongs to your torch with `pip install torchvision`, or use frechet_scene_distance"
        ) from error
    state = _read_state(path)
    classes = int(state["fc.weight"].shape[0])
    network = Inception3(num_classes=classes, aux_logits=False, transform_input=False, init_weights=False)
    state = {name: value for name, value in state.items() if not name.startswith("AuxLogits.")}
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        raise CorruptFileError(f"{str(path)!r} does not fit an Inception-v3: {error}") from error
    if classes == _FID_CLASSES:
        _pool_like_tensorflow(network)
    network.fc = nn.Identity()
    return network.eval().requires_grad_(False)  # type: ignore[no-any-return]


class _Pooling(nn.Module):
    """An Inception block with another pooling in its pooling branch, which is the last one."""

    def __init__(self, block: nn.Module, maximum: bool) -> None:
        super().__init__()
        self.block, self.maximum = block, maximum

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H, W)."""
        if self.maximum:
            pooled = F.max_pool2d(x, kernel_size=3, stride=1, padding=1)
        else:
            pooled = F.avg_pool2d(x, kernel_size=3, stride=1, padding=1, count_include_pad=False)
        branch = self.block.branch_pool(pooled)  # type: ignore[operator]
        return torch.cat([self.block(x)[:, : -branch.shape[1]], branch], dim=1)


def _pool_like_tensorflow(network: nn.Module) -> None:
    """Pool as the 2015 network does: averages leave out the padding, and the last block takes maxima."""
    for name in ("5b", "5c", "5d", "6b", "6c", "6d", "6e", "7b", "7c"):
        setattr(network, f"Mixed_{name}", _Pooling(getattr(network, f"Mixed_{name}"), maximum=name == "7c"))


def _read_state(path: Path) -> dict[str, Tensor]:
    try:
        if path.suffix == ".safetensors":
            state: Any = read_tensors(path)[0]
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except CorruptFileError:
        raise
    except Exception as error:  # torch's own message advises to run the code in the file
        raise CorruptFileError(f"{str(path)!r} cannot be read as a state dict ({type(error).__name__})") from error
    if not isinstance(state, dict) or "fc.weight" not in state:
        raise CorruptFileError(f"{str(path)!r} is not a state dict of an Inception-v3: it lacks 'fc.weight'")
    return state


@torch.no_grad()
def _features(network: nn.Module, batch: SceneBatch, width: int, height: int, batch_size: int) -> NDArray[np.float64]:
    from scene_envs.render import render

    parts = []
    for start in range(0, len(batch), batch_size):
        images = render(batch[start : start + batch_size], style="semantic", width=width, height=height)
        pixels = torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1.0
        pixels = F.interpolate(pixels, size=(_SIDE, _SIDE), mode="bilinear", align_corners=False)
        parts.append(network(pixels).double().numpy())
    return np.concatenate(parts) if parts else np.empty((0, 2048))
