"""Inpainting by clamping: some slots are regenerated, the others guide them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from agents.prior import ScenePrior


@torch.no_grad()
def inpaint(
    prior: ScenePrior,
    batch: SceneBatch,
    mask: Tensor,
    *,
    num_steps: int = 50,
    generators: Sequence[Generator] | None = None,
    seed: int = 0,
) -> SceneBatch:
    """Regenerate masked slots given the others (Lugmayr et al. 2022, Eq. 8, without resampling).

    At every noise level the kept slots are replaced by themselves with that level's noise, so the network
    denoises the masked ones in their company.

    Args:
        prior: what denoises.
        batch: scenes to change.
        mask: (B, N) bool, True where a slot is regenerated; fixed welded slots never are.
        num_steps: denoiser evaluations, 1..T.
        generators: one per scene, so that a scene's result does not depend on its neighbours' noise.
        seed: used to make the generators when none are given.

    Returns:
        Scenes whose unmasked slots are bit-identical to those of ``batch``.

    Raises:
        InvalidInputError: a mask of the wrong shape or type, or not one generator per scene.
    """
    _check(batch, mask, generators)
    if generators is None:
        generators = [Generator().manual_seed(seed + i) for i in range(len(batch))]
    known_x0 = prior.encode(batch)
    keep = ~mask.unsqueeze(-1)
    table = prior.step_table(num_steps)
    x = prior.clamp(_noise(generators, known_x0))
    for step in range(len(table)):
        noisy_known = prior.process.add_noise(known_x0, table.timesteps[step], _noise(generators, known_x0))
        x = prior.clamp(torch.where(keep, noisy_known, x))
        x = prior.transition(x, step, table).from_noise(_noise(generators, known_x0))
    changed = mask.clone()
    changed[:, : len(prior.scene_type.fixed)] = False
    regenerated = prior.decode(x).tensor
    return SceneBatch(torch.where(changed.unsqueeze(-1), regenerated, batch.tensor), batch.scene_type)


def _noise(generators: Sequence[Generator], like: Tensor) -> Tensor:
    """Standard normal (B, N, D), each scene from its own CPU generator."""
    return torch.stack([torch.randn(like.shape[1:], generator=g) for g in generators]).to(like.device)


def _check(batch: SceneBatch, mask: Tensor, generators: Sequence[Generator] | None) -> None:
    expected = tuple(batch.tensor.shape[:2])
    if tuple(mask.shape) != expected or mask.dtype != torch.bool:
        raise InvalidInputError(f"mask must be bool of shape {expected}, got {mask.dtype} {tuple(mask.shape)}")
    if generators is not None and len(generators) != len(batch):
        raise InvalidInputError(f"{len(generators)} generators for {len(batch)} scenes; give one per scene")
