"""Moments of the data that scale network inputs and outputs (Karras et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from agents.diffusion.categorical import CategoricalProcess

_MIN_SLOTS = 20
"""Smallest number of slots of a category from which its own moments are taken."""


@dataclass(frozen=True)
class CategoryMoments:
    """Moments of normalised poses, category by category; the last of the K categories is *empty*.

    Attributes:
        share: (K,) frequency of each category among slots; sums to 1.
        mean: (K, D).
        std: (K, D), floored away from zero.
    """

    share: Tensor
    mean: Tensor
    std: Tensor

    @classmethod
    def fit(cls, poses: Tensor, categories: Tensor, count: int, floor: float = 1e-3) -> CategoryMoments:
        """Moments of poses (M, D) whose categories are (M,) in 0..``count`` - 1.

        A category with fewer than 20 slots takes the moments of all objects, because too small a standard deviation
        makes the targets of poses far from the mean very large. *Empty* has the mean of all objects and the standard
        deviation ``floor``.
        """
        poses = poses.double()
        object_poses = poses[categories != count - 1]
        mean, std = object_poses.mean(dim=0).repeat(count, 1), object_poses.std(dim=0).repeat(count, 1)
        std[-1] = 0.0
        for category in range(count - 1):
            own = poses[categories == category]
            if len(own) >= _MIN_SLOTS:
                mean[category], std[category] = own.mean(dim=0), own.std(dim=0)
        share = torch.bincount(categories, minlength=count).double() + 1e-3
        return cls((share / share.sum()).float(), mean.float(), std.clamp(min=floor).float())

    def given_state(self, process: CategoricalProcess) -> tuple[Tensor, Tensor]:
        """E[x_0 | state at t] and its standard deviation, (T + 1, K + 1, D) each, K being the mask token.

        A state may be wrong where the kernel replaces categories. So the moments follow from the laws of total
        expectation and variance over the clean category, whose posterior follows from ``share`` by Bayes' rule.
        """
        categories = torch.arange(process.categories)
        steps = process.schedule.num_timesteps + 1
        levels = torch.arange(steps).repeat_interleave(process.categories)
        likelihood = process.marginal(categories.repeat(steps), levels).view(steps, process.categories, -1)
        joint = self.share.double()[:, None] * likelihood.double()  # (T + 1, K, K + 1)
        total = joint.sum(dim=1, keepdim=True)
        prior = self.share.double()[:, None].expand_as(joint)
        clean = torch.where(total > 1e-12, joint / total.clamp(min=1e-12), prior).transpose(1, 2)  # (T + 1, K + 1, K)
        mean = clean @ self.mean.double()
        square = clean @ (self.std.double().square() + self.mean.double().square())
        variance = (square - mean.square()).clamp(min=float(self.std.min()) ** 2)
        return mean.float(), variance.sqrt().float()


@dataclass(frozen=True)
class Preconditioning:
    """Per-feature first and second moments of normalised data.

    Attributes:
        mean: (D,) mean.
        std: (D,) standard deviation, floored away from zero.
        by_category: moments of each category; None if the process scales all categories alike.
    """

    mean: Tensor
    std: Tensor
    by_category: CategoryMoments | None = None

    @classmethod
    def fit(cls, data: Tensor, floor: float = 0.05) -> Preconditioning:
        """Moments of normalised scenes (..., D)."""
        flat = data.reshape(-1, data.shape[-1]).double()
        return cls(flat.mean(dim=0).float(), flat.std(dim=0).clamp(min=floor).float())

    def pooled(self) -> Preconditioning:
        """One standard deviation for all features (their root mean square), as Karras et al. use."""
        return Preconditioning(self.mean, self.std.square().mean().sqrt().expand_as(self.std).clone())

    def state(self) -> dict[str, Any]:
        """The moments as JSON."""
        state: dict[str, Any] = {"mean": self.mean.tolist(), "std": self.std.tolist()}
        if self.by_category is not None:
            own = self.by_category
            state["by_category"] = {"share": own.share.tolist(), "mean": own.mean.tolist(), "std": own.std.tolist()}
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Preconditioning:
        """Inverse of :meth:`state`; raises KeyError on a missing entry, ValueError where entries cannot be moments."""
        own = state.get("by_category")
        by_category = (
            None if own is None else CategoryMoments(*(torch.tensor(own[k]) for k in ("share", "mean", "std")))
        )
        mean, std = (torch.tensor(state[key], dtype=torch.float32) for key in ("mean", "std"))
        known = [mean, std, *([] if by_category is None else (by_category.share, by_category.mean, by_category.std))]
        if mean.shape != std.shape or mean.ndim != 1 or not all(bool(torch.isfinite(part).all()) for part in known):
            raise ValueError("the moments of the preconditioning must be finite numbers, one mean and std per feature")
        return cls(mean, std, by_category)
