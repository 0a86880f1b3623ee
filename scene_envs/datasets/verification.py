"""Verification of generated scenes: inside the workspace, free of penetration, and at rest."""

from __future__ import annotations

import math

import torch

from scene_envs.scene import SceneBatch

MAX_PENETRATION = 1e-3
"""Deepest overlap (m) of any pair of objects in a kept scene."""
MAX_DISPLACEMENT = 1e-2
"""Largest motion (m) of any object of a kept scene while it settles."""
DURATION = 0.5
"""Time (s) for which a scene settles."""
KEPT = ""
"""The verdict on a scene that is kept."""


def judge_scenes(batch: SceneBatch) -> list[str]:
    """Reason why each scene is rejected: ``"outside workspace"``, ``"penetration"``, … or :data:`KEPT`.

    Runs in the calling process. Scenes are judged in the constructed poses; settling only tests them. The verdict on
    a scene does not depend on the others of the batch.
    """
    inside = (batch.in_workspace | batch.is_empty).all(dim=1)
    verdicts = [KEPT if ok else "outside workspace" for ok in inside.tolist()]
    candidates = torch.nonzero(inside).flatten()
    if len(candidates):
        for index, verdict in zip(candidates.tolist(), _physics(batch[candidates]), strict=True):
            verdicts[index] = verdict
    return verdicts


def _physics(batch: SceneBatch) -> list[str]:
    from scene_envs.physics import feasibility

    result = feasibility(
        batch,
        max_penetration=MAX_PENETRATION,
        max_displacement=MAX_DISPLACEMENT,
        max_rotation=math.inf,
        duration=DURATION,
    )
    shallow = (result.depth <= MAX_PENETRATION).all(dim=1)
    still = ((result.displacement <= MAX_DISPLACEMENT) | ~batch.is_free).all(dim=1)
    return [
        "physics failed" if not valid else "penetration" if not clear else "moved while settling" if not calm else KEPT
        for valid, clear, calm in zip(result.valid.tolist(), shallow.tolist(), still.tolist(), strict=True)
    ]
