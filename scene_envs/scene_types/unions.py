"""Union of several scene types as one scene type."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.scene_types.base import SceneType


def union_of(members: Sequence[SceneType], name: str) -> SceneType:
    """The scene type called ``name`` that holds the scenes of all ``members`` (at least one)."""
    lows, highs = ([member.workspace[end] for member in members] for end in (0, 1))
    largest = max(members, key=lambda member: member.workspace[1][0] - member.workspace[0][0])
    return SceneType(
        name=name,
        assets=tuple(sorted({asset for member in members for asset in member.assets})),
        slots=max(member.slots for member in members),
        workspace=(
            (min(c[0] for c in lows), min(c[1] for c in lows), min(c[2] for c in lows)),
            (max(c[0] for c in highs), max(c[1] for c in highs), max(c[2] for c in highs)),
        ),
        welded=tuple(sorted({asset for member in members for asset in member.welded})),
        fixed=tuple(fixed for fixed in members[0].fixed if all(fixed in member.fixed for member in members)),
        camera=largest.camera,
        description="Scenes of " + ", ".join(dict.fromkeys(member.name for member in members)) + ".",
        asset_folders=tuple(dict.fromkeys(folder for member in members for folder in member.asset_folders)),
    )
