"""Results of one step of the denoising MDP, and rows of their tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.scoring import Score
from scene_envs.scene import SceneBatch

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
IntArray = np.ndarray[Any, np.dtype[np.int64]]


@dataclass(frozen=True)
class StepResult:
    """Result of one step of the B episodes of a core.

    Attributes:
        reward: (B,) float32; 0 before the last step and where ``valid`` is False.
        valid: (B,) bool; False where the reward could not score the finished scene.
        terminated: (B,) bool, on the CPU.
        terms: named (B,) float32 of the reward; 0 before the last step.
        score: the full verdict, when all B episodes ended in this step; else None.
        batch: the B finished scenes, likewise.
    """

    reward: Tensor
    valid: Tensor
    terminated: BoolArray
    terms: dict[str, Tensor]
    score: Score | None = None
    batch: SceneBatch | None = None


def take_rows(x: Tensor, rows: IntArray) -> Tensor:
    """``x[rows]`` without a copy when ``rows`` are all of them."""
    return x if len(rows) == x.shape[0] else x[torch.from_numpy(rows).to(x.device)]


def replace_rows(x: Tensor, rows: IntArray, values: Tensor) -> Tensor:
    """A new tensor: ``x`` with ``rows`` (ascending) set to ``values``."""
    if len(rows) == x.shape[0]:
        return values
    changed = x.clone()
    changed[torch.from_numpy(rows).to(x.device)] = values
    return changed
