"""Partly observed scenes: the mask of the regenerated entries, and the observed entries in the states of a chain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.scene import CATEGORY, POSE, SceneBatch

Noise = Callable[[], Tensor]
"""``() -> (B, N, D)``: standard normal noise."""


class Writer(Protocol):
    """A prior that writes observed entries into states."""

    def write_observed(self, x: Tensor, x0: Tensor, observed: Tensor, level: int, noise: Noise | None) -> Tensor:
        """``x`` at timestep ``level`` with the ``observed`` entries of ``x0``."""


@dataclass(frozen=True)
class ObservedScenes:
    """B scenes with observed entries, which every state and every result of a chain holds.

    Made by :meth:`ScenePrior.observe`; environments take it for the episodes of an inpainting.

    Attributes:
        prior: the prior that denoises the other entries.
        batch: the scenes.
        mask: (B, N, 2) bool, True where the pose, or the category, of a slot is regenerated.
        x0: (B, N, D) the scenes as the prior encodes them.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> observed = prior.observe(prior.sample(2, num_steps=3), torch.zeros(2, 34, dtype=torch.bool))
    >>> x = observed.write(prior.initial(2, 34), 0)
    >>> bool((x == observed.x0).all()), bool(observed.entries.all())
    (True, True)
    """

    prior: Writer
    batch: SceneBatch
    mask: Tensor
    x0: Tensor

    @property
    def entries(self) -> Tensor:
        """(B, N, 2) bool, True where the pose, or the category, of a slot is observed."""
        return ~self.mask

    def write(self, x: Tensor, level: int, noise: Noise | None = None) -> Tensor:
        """``x`` (B, N, D) at timestep ``level`` with the observed entries in place.

        Args:
            x: states.
            level: timestep, 0 for finished scenes.
            noise: gives standard normal noise (B, N, D), for priors that read observed entries with the noise of each
                level; None for torch's own.
        """
        return self.prior.write_observed(x, self.x0, self.entries.to(x.device), level, noise)

    def merge(self, scenes: SceneBatch) -> SceneBatch:
        """``scenes`` with the observed entries of the batch, bit for bit."""
        return merge(self.batch, scenes, self.mask)


def check_mask(
    batch: SceneBatch, mask: Tensor, generators: Sequence[Generator] | None = None, resample: int = 1
) -> Tensor:
    """The mask as (B, N, 2), a copy; raises InvalidInputError when an argument does not fit ``batch``."""
    expected = tuple(batch.tensor.shape[:2])
    if tuple(mask.shape) not in (expected, (*expected, 2)) or mask.dtype != torch.bool:
        raise InvalidInputError(
            f"mask must be bool of shape {expected}, or {(*expected, 2)} for pose and category, "
            f"got {mask.dtype} {tuple(mask.shape)}"
        )
    if generators is not None and len(generators) != len(batch):
        raise InvalidInputError(f"{len(generators)} generators for {len(batch)} scenes; give one per scene")
    if resample < 1:
        raise InvalidInputError(f"resample={resample}: every step is taken at least once")
    return (mask if mask.ndim == 3 else torch.stack([mask, mask], dim=-1)).clone()


def merge(batch: SceneBatch, new: SceneBatch, mask: Tensor) -> SceneBatch:
    """``batch`` with the poses and categories of ``new`` where ``mask`` (B, N, 2) says so."""
    empty = batch.scene_type.num_assets
    taken = mask[..., 1] & (mask[..., 0] | (new.is_empty == batch.is_empty))  # if the pose is kept, emptiness is too
    category = torch.where(taken[..., None], new.tensor[..., CATEGORY], batch.tensor[..., CATEGORY])
    pose = torch.where(mask[..., :1], new.tensor[..., POSE], batch.tensor[..., POSE])
    gone = category.argmax(dim=-1, keepdim=True) == empty
    return SceneBatch(torch.cat([torch.where(gone, torch.zeros_like(pose), pose), category], dim=-1), batch.scene_type)
