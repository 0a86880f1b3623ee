"""A mask: everything."""

import torch


def everything(scene, score, rng):
    """All slots are regenerated."""
    return torch.ones(scene.tensor.shape[1], dtype=torch.bool)
