"""Inpainting: regeneration of slots, poses or categories given the observed entries."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Generator, Tensor

from agents.diffusion.step_tables import StepTable
from agents.priors.guidance import guidance_hook, physics_strength
from agents.priors.hooks import Guide, Hook, Start, Watch
from agents.priors.observed_scenes import check_mask, merge
from agents.priors.prompt_validation import check_prompts
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType


class Inpainting(ABC):
    """The part of a prior that regenerates some of a scene and keeps the rest: inpainting, completion, rearrangement.

    The network of a mixed prior reads the kept entries without noise. That of a continuous prior reads them with the
    noise of each level (Lugmayr et al. 2022, Eq. 8).
    """

    scene_type: SceneType
    normalizer: Normalizer
    config: Any

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""
        return False

    @property
    @abstractmethod
    def device(self) -> torch.device:
        """Device of the weights."""

    @abstractmethod
    def step_table(self, num_steps: int) -> StepTable:
        """The reverse steps of a chain of ``num_steps``, any number in 1..T."""

    @abstractmethod
    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes from normalised x_0 (B, N, D); known entries take their exact values."""

    @abstractmethod
    def regenerate(
        self,
        batch: SceneBatch,
        mask: Tensor,
        table: StepTable,
        generators: Sequence[Generator],
        resample: int,
        prompts: Sequence[str] | None = None,
        guidance: float = 0.0,
        hook: Hook | None = None,
        start: Start | None = None,
    ) -> Tensor:
        """x_0 (B, N, D) in which poses and categories under ``mask`` (B, N, 2) are new; used by :meth:`inpaint`."""

    @abstractmethod
    def estimate(self, step: int, table: StepTable) -> tuple[float, Tensor]:
        """Weight of the denoised translations in x_{t-1}, and their standard deviation (3,), normalised."""

    @abstractmethod
    def encode(self, batch: SceneBatch) -> Tensor:
        """Normalised x_0 (B, N, D) of scenes."""

    def closed_categories(self, batch: SceneBatch, mask: Tensor) -> Tensor:
        """(B, K) bool: categories that the slots under ``mask`` (B, N, 2) must not take.

        These are the welded assets, in scenes that keep generated furniture and regenerate none. No mask generator
        masks furniture, so without this rule every further inpainting of empty slots would add furniture.
        """
        changed = mask[..., 1]
        masked = self.closed_by_furniture(batch.categories, changed).any(dim=1)
        return self.closed_by_furniture(batch.categories, ~changed) & ~masked[:, None]

    def closed_by_furniture(self, categories: Tensor, slots: Tensor) -> Tensor:
        """(B, K) bool: the welded assets, in scenes with generated furniture in ``slots``.

        Args:
            categories: (B, N) int64 index of each slot's asset.
            slots: (B, N) bool.
        """
        welded = torch.zeros(self.scene_type.num_assets + 1, dtype=torch.bool, device=categories.device)
        welded[list(self.scene_type.welded_categories)] = True
        indices = torch.tensor(self.scene_type.welded_categories, device=categories.device, dtype=torch.long)
        furniture = torch.isin(categories, indices) & slots
        return furniture[:, len(self.scene_type.fixed) :].any(dim=1, keepdim=True) & welded

    @torch.no_grad()
    def inpaint(
        self,
        batch: SceneBatch,
        mask: Tensor,
        *,
        prompt: str | Sequence[str] | None = None,
        guidance: float = 0.0,
        claim_guidance: float = 0.0,
        physics_guidance: float | None = None,
        num_steps: int = 50,
        generators: Sequence[Generator] | None = None,
        seed: int = 0,
        resample: int = 1,
        watch: Watch | None = None,
        guide: Guide | None = None,
    ) -> SceneBatch:
        """Regenerate the masked entries, given the rest.

        A room keeps its furniture: if generated welded objects are kept and none is masked, masked slots take no
        welded asset.

        Args:
            batch: scenes to change.
            mask: bool, True where something is regenerated: (B, N) for whole slots, or (B, N, 2) for the pose and the
                category of each slot. Fixed welded slots are never regenerated.
            prompt: what the whole scenes should hold in the end, one text for all or one per scene; None for anything.
            guidance: w of classifier-free guidance, (1 + w) conditional - w unconditional; it needs a prompt.
            claim_guidance: strength of guidance to the claims of the prompt, see
                :class:`~agents.priors.claim_guidance.ClaimGuidance` and
                :class:`~agents.priors.number_guidance.NumberGuidance`; it needs a prompt.
            physics_guidance: strength with which regenerated objects are moved out of overlaps and onto supports at the
                last steps, 0 to 1, see :class:`~agents.priors.physics_guidance.PhysicsGuidance`. None takes the
                strength of the prior, as :meth:`ScenePrior.sample` does.
            num_steps: denoiser evaluations of one pass, 1..T.
            generators: one per scene, so that a scene's result does not depend on its neighbours' noise.
            seed: used to make the generators when none are given.
            resample: number of times that each step is taken, with noise added again in between (Lugmayr et al. 2022,
                Algorithm 1).
            watch: called at every step; chooses the scenes that continue. A scene may be replaced only by one with the
                same rows of ``batch`` and ``mask``.
            guide: moves the poses that are regenerated.

        Returns:
            Scenes on the device of ``batch``, whose unmasked entries are bit-identical to its own. Where the category
            alone is regenerated, an object stays an object and an empty slot stays empty, as the pose is kept.

        Raises:
            InvalidInputError: a mask of the wrong shape or type, not one generator per scene, ``resample`` below 1, a
                prompt for a prior that reads none, guidance without a prompt, ``claim_guidance`` below 0, or
                ``physics_guidance`` outside 0 to 1.
        """
        both = check_mask(batch, mask, generators, resample).to(batch.tensor.device)
        both[:, : len(self.scene_type.fixed)] = False
        slots = batch.tensor.shape[1]
        prompts = check_prompts(
            prompt, guidance, len(batch), scene_type=self.scene_type, slots=slots, conditional=self.conditional,
            claim_guidance=claim_guidance,
        )  # fmt: skip
        strength = physics_strength(physics_guidance, self.config, self.scene_type)
        if generators is None:
            generators = [Generator().manual_seed(seed + i) for i in range(len(batch))]
        device, table = self.device, self.step_table(num_steps)
        moved = both[..., :1]

        def scenes(x: Tensor) -> SceneBatch:
            return merge(batch, self.decode(x).to(batch.tensor.device), both)

        hook = guidance_hook(
            self, self.scene_type, table, scenes, moved, prompts=prompts, claim_guidance=claim_guidance,
            physics_guidance=strength, guide=guide, watch=watch,
        )  # fmt: skip
        begins = getattr(watch, "start", None)
        start = None if begins is None else begins(len(table))
        x = self.regenerate(
            batch.to(device), both.to(device), table, generators, resample, prompts, guidance, hook, start
        )
        return merge(batch, self.decode(x).to(batch.tensor.device), both)

    def complete(
        self,
        batch: SceneBatch,
        *,
        prompt: str | Sequence[str] | None = None,
        guidance: float = 0.0,
        claim_guidance: float = 0.0,
        physics_guidance: float | None = None,
        slots: int | None = None,
        fill: int | None = None,
        num_steps: int = 50,
        seed: int = 0,
    ) -> SceneBatch:
        """Fill the empty slots of ``batch``, keeping its objects.

        With all empty slots open, a prior crowds a scene. With ``fill`` open slots, it adds at most that many objects.

        Args:
            batch: scenes.
            prompt: what the completed scenes should hold, one text for all or one per scene; None for anything.
            guidance, claim_guidance, physics_guidance: as in :meth:`inpaint`.
            slots: slots of the result, at least those of ``batch``; None keeps them.
            fill: most objects to add to a scene; None for as many as there are empty slots.
            num_steps: denoiser evaluations per scene.
            seed: of the noise; scene i uses ``seed + i``.
        """
        wide = batch if slots is None else batch.with_slots(slots)
        if fill is not None and fill < 0:
            raise InvalidInputError(f"fill={fill}: give the most objects to add, at least 0, or None")
        open_slots = wide.is_empty if fill is None else wide.is_empty & (wide.is_empty.cumsum(dim=1) <= fill)
        return self.inpaint(
            wide, open_slots, prompt=prompt, guidance=guidance, claim_guidance=claim_guidance,
            physics_guidance=physics_guidance, num_steps=num_steps, seed=seed,
        )  # fmt: skip

    def rearrange(
        self,
        batch: SceneBatch,
        *,
        prompt: str | Sequence[str] | None = None,
        guidance: float = 0.0,
        claim_guidance: float = 0.0,
        physics_guidance: float | None = None,
        num_steps: int = 50,
        seed: int = 0,
    ) -> SceneBatch:
        """New poses for the free objects of ``batch``; all categories, and the poses of welded objects, stay.

        Arguments as in :meth:`complete`.
        """
        free = batch.is_free
        mask = torch.stack([free, torch.zeros_like(free)], dim=-1)
        return self.inpaint(
            batch, mask, prompt=prompt, guidance=guidance, claim_guidance=claim_guidance,
            physics_guidance=physics_guidance, num_steps=num_steps, seed=seed,
        )  # fmt: skip


def draw_noise(like: Tensor, generators: Sequence[Generator] | Generator | None) -> Tensor:
    """Standard normal noise shaped as ``like`` (B, N, D), from one generator or one CPU generator per scene."""
    if generators is None or isinstance(generators, Generator):
        return torch.randn(like.shape, generator=generators, device=like.device)
    return torch.stack([torch.randn(like.shape[1:], generator=g) for g in generators]).to(like.device)
