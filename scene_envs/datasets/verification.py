"""Which generated scenes are kept: inside the workspace, free of penetration, and at rest."""

from __future__ import annotations

import math
from collections import Counter

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch

MAX_PENETRATION = 1e-3
"""Deepest overlap (m) of any pair of objects in a kept scene."""
MAX_DISPLACEMENT = 1e-2
"""How far (m) any object of a kept scene may move while it settles."""
DURATION = 0.5
"""How long (s) a scene settles."""


def verify_scenes(batch: SceneBatch, reasons: Counter[str]) -> Tensor:
    """(B,) bool: scenes to keep; why others are thrown away is counted in ``reasons``.

    Runs in the calling process. Scenes are judged in the constructed poses; settling only tests them.
    """
    kept = (batch.in_workspace | batch.is_empty).all(dim=1)
    reasons["outside workspace"] += int((~kept).sum())
    candidates = torch.nonzero(kept).flatten()
    if len(candidates):
        passed = _physics(batch[candidates], reasons)
        kept[candidates] = passed
    return kept


def _physics(batch: SceneBatch, reasons: Counter[str]) -> Tensor:
    from scene_envs.physics import feasibility

    result = feasibility(
        batch,
        max_penetration=MAX_PENETRATION,
        max_displacement=MAX_DISPLACEMENT,
        max_rotation=math.inf,
        duration=DURATION,
    )
    valid = result.valid
    shallow = (result.depth <= MAX_PENETRATION).all(dim=1)
    still = ((result.displacement <= MAX_DISPLACEMENT) | ~batch.is_free).all(dim=1)
    reasons["physics failed"] += int((~valid).sum())
    reasons["penetration"] += int((valid & ~shallow).sum())
    reasons["moved while settling"] += int((valid & shallow & ~still).sum())
    return valid & shallow & still
