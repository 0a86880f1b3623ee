"""Low-rank updates of attention and MLP matrices (LoRA; Hu et al. 2021), as torch parametrizations of a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from scene_envs.errors import InvalidInputError

_PARAMETERS = ".parametrizations.weight.0"


class LowRank(nn.Module):
    """``weight + scale * up @ down``; ``up`` starts at zero, so that nothing changes at first.

    Args:
        weight: (O, I) the matrix that stays as it is.
        rank: columns of ``up`` (O, rank) and rows of ``down`` (rank, I).
        scale: of the update.

    >>> layer = nn.Linear(3, 2)
    >>> update = LowRank(layer.weight, rank=1, scale=4.0)
    >>> bool((update(layer.weight) == layer.weight).all())
    True
    """

    def __init__(self, weight: Tensor, rank: int, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.down = nn.Parameter(torch.empty(rank, weight.shape[1]))
        self.up = nn.Parameter(torch.zeros(weight.shape[0], rank))
        nn.init.kaiming_uniform_(self.down, a=5**0.5)

    def forward(self, weight: Tensor) -> Tensor:
        """The updated matrix (O, I)."""
        return weight + self.scale * (self.up @ self.down)


def matrices(network: nn.Module) -> Iterator[tuple[str, nn.Linear]]:
    """Attention and MLP layers of a network by name: those that its blocks list as ``MATRICES``."""
    for name, block in network.named_modules():
        for path in getattr(block, "MATRICES", ()):
            if hasattr(block, path.partition(".")[0]):  # the last block of a stream may lack some
                layer = block.get_submodule(path)
                assert isinstance(layer, nn.Linear)
                yield f"{name}.{path}".lstrip("."), layer


def add_low_rank(network: nn.Module, rank: int, scale: float, seed: int) -> None:
    """Freeze a network, and give each of its attention and MLP matrices an update that is trained.

    Raises:
        InvalidInputError: the network lists no such matrices, or one is smaller than ``rank``.
    """
    layers = dict(matrices(network))
    if not layers:
        raise InvalidInputError(
            f"adapter.rank={rank}: the network {type(network).__name__} names no attention or MLP matrices; let its "
            "blocks list theirs as MATRICES, or train all weights with adapter.rank=0"
        )
    smallest, name = min((min(layer.weight.shape), name) for name, layer in layers.items())
    if rank > smallest:
        raise InvalidInputError(f"adapter.rank={rank} exceeds the {smallest} rows or columns of {name!r}; give less")
    network.requires_grad_(False)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for layer in layers.values():
            update = LowRank(layer.weight, rank, scale).to(layer.weight.device)
            parametrize.register_parametrization(layer, "weight", update)


def low_rank_tensors(network: nn.Module) -> dict[str, Tensor]:
    """The updates of a network: ``NAME.down`` and ``NAME.up`` of each matrix."""
    found = ((name, parameter) for name, parameter in network.named_parameters() if _PARAMETERS in name)
    return {name.replace(_PARAMETERS, ""): parameter for name, parameter in found}


@torch.no_grad()
def set_low_rank(network: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Inverse of :func:`low_rank_tensors`."""
    for name, parameter in low_rank_tensors(network).items():
        parameter.copy_(tensors[name])


def merged_weights(network: nn.Module) -> dict[str, Tensor]:
    """Weights of a network with the updates added to them, by their names in a network without updates."""
    weights = dict(network.state_dict())
    for name, layer in matrices(network):
        if parametrize.is_parametrized(layer, "weight"):
            weights = {key: value for key, value in weights.items() if not key.startswith(f"{name}.parametrizations.")}
            weights[f"{name}.weight"] = layer.weight.detach()
    return weights


@torch.no_grad()
def merge(network: nn.Module, tensors: Mapping[str, Tensor], scale: float) -> None:
    """Add ``scale * up @ down`` to the matrices of a network without updates of its own.

    Raises:
        KeyError, RuntimeError: the updates are of another network.
    """
    layers = dict(matrices(network))
    for name in sorted({name.rpartition(".")[0] for name in tensors}):
        weight = layers[name].weight
        weight += scale * (tensors[f"{name}.up"] @ tensors[f"{name}.down"]).to(weight)
