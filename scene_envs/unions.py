"""One scene type for the scenes of several."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import SceneType, get_scene_type


def union_scene_type(types: Sequence[str | SceneType], name: str | None = None) -> SceneType:
    """The scene type that holds the scenes of all ``types``.

    Its assets are all of theirs by name, its slots the most of any, its workspace the box around theirs. Assets that
    are welded in one type are welded in the union; its folders of users' assets are those of all. Only objects that
    are fixed in the same pose in *every* type stay fixed; the others are objects like any other, in any slot.

    Args:
        types: at least one scene type or name.
        name: of the union; the names joined by ``+`` when None, by which it is known everywhere. Another name is not
            registered: files that hold it need :func:`~scene_envs.scene_types.register_scene_type`.

    Raises:
        InvalidInputError: no types given.
        UnknownNameError: a name that is no scene type.

    >>> union = union_scene_type(["dimsum_table", "pantry_shelf"])
    >>> union.name, union.num_assets, union.slots, union.fixed
    ('dimsum_table+pantry_shelf', 21, 61, ())
    """
    members = [get_scene_type(member) for member in types]
    if not members:
        raise InvalidInputError("a union needs at least one scene type, got none")
    lows, highs = ([member.workspace[end] for member in members] for end in (0, 1))
    largest = max(members, key=lambda member: member.workspace[1][0] - member.workspace[0][0])
    return SceneType(
        name=name or "+".join(dict.fromkeys(member.name for member in members)),
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
