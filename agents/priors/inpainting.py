"""Inpainting: some slots, poses or categories are regenerated, the others guide them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from agents.diffusion.step_tables import StepTable
from agents.priors.prompt_validation import check_prompts
from scene_envs.errors import InvalidInputError
from scene_envs.scene import CATEGORY, POSE, SceneBatch

if TYPE_CHECKING:
    from agents.priors.base import ScenePrior


@torch.no_grad()
def inpaint(
    prior: ScenePrior,
    batch: SceneBatch,
    mask: Tensor,
    *,
    prompt: str | Sequence[str] | None = None,
    guidance: float = 0.0,
    num_steps: int = 50,
    generators: Sequence[Generator] | None = None,
    seed: int = 0,
    resample: int = 1,
) -> SceneBatch:
    """Regenerate what is masked, given the rest.

    A mixed prior sees what is kept without noise. A continuous prior sees it with the noise of every level (Lugmayr et
    al. 2022, Eq. 8).

    Args:
        prior: what denoises.
        batch: scenes to change.
        mask: bool, True where something is regenerated: (B, N) for whole slots, or (B, N, 2) for the pose and the
            category of each slot. Fixed welded slots never are.
        prompt: what the whole scenes should hold in the end, one text for all or one per scene; None for anything.
        guidance: w of classifier-free guidance, (1 + w) conditional - w unconditional; it needs a prompt.
        num_steps: denoiser evaluations of one pass, 1..T.
        generators: one per scene, so that a scene's result does not depend on its neighbours' noise.
        seed: used to make the generators when none are given.
        resample: how often each step is taken, going back in between (Lugmayr et al. 2022, Algorithm 1); 1 is once.

    Returns:
        Scenes on the device of ``batch``, whose unmasked entries are bit-identical to its own. Where the category alone
        is regenerated, an object stays an object and an empty slot stays empty, as the pose is kept.

    Raises:
        InvalidInputError: a mask of the wrong shape or type, not one generator per scene, ``resample`` below 1, a
            prompt for a prior that reads none, or guidance without a prompt.
    """
    both = check_mask(batch, mask, generators, resample).to(batch.tensor.device)
    both[:, : len(prior.scene_type.fixed)] = False
    prompts = check_prompts(prior, prompt, guidance, len(batch), batch.tensor.shape[1])
    if generators is None:
        generators = [Generator().manual_seed(seed + i) for i in range(len(batch))]
    device = prior.known(1).device
    table = prior.step_table(num_steps)
    x = prior.regenerate(batch.to(device), both.to(device), table, generators, resample, prompts, guidance)
    return merge(batch, prior.decode(x).to(batch.tensor.device), both)


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
    taken = mask[..., 1] & (mask[..., 0] | (new.is_empty == batch.is_empty))  # a kept pose, or none, stays one
    category = torch.where(taken[..., None], new.tensor[..., CATEGORY], batch.tensor[..., CATEGORY])
    pose = torch.where(mask[..., :1], new.tensor[..., POSE], batch.tensor[..., POSE])
    gone = category.argmax(dim=-1, keepdim=True) == empty
    return SceneBatch(torch.cat([torch.where(gone, torch.zeros_like(pose), pose), category], dim=-1), batch.scene_type)


def chain_with_noised(
    prior: ScenePrior, x0: Tensor, keep: Tensor, table: StepTable, generators: Sequence[Generator], resample: int
) -> Tensor:
    """x_0 from a chain in which entries ``keep`` (B, N, D) of ``x0`` are put in with each level's noise."""
    x = prior.clamp(scene_noise(generators, x0))
    for step in range(len(table)):
        level, after = table.timesteps[step], int(table.previous[step])
        for again in range(resample if after > 0 else 1):
            if again:
                x = prior.process.renoise(x, after, int(level), scene_noise(generators, x0))
            noised = prior.process.add_noise(x0, level, scene_noise(generators, x0))
            x = prior.clamp(torch.where(keep, noised, x))
            x = prior.transition(x, step, table).from_noise(scene_noise(generators, x0))
    return torch.where(keep, x0, x)


def scene_noise(generators: Sequence[Generator], like: Tensor) -> Tensor:
    """Standard normal (B, N, D), each scene from its own CPU generator."""
    return torch.stack([torch.randn(like.shape[1:], generator=g) for g in generators]).to(like.device)
