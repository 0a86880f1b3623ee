"""One category space for several scene types: what a prior trained on all of them needs."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from scene_envs.datasets.layout import place_fixed
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type


def union_scene_type(types: Sequence[str | SceneType], name: str | None = None) -> SceneType:
    """The scene type that holds the scenes of all ``types``.

    Its assets are all of theirs by name, its slots the most of any, its workspace the box around theirs. Assets that
    are welded in one type are welded in the union; its folders of users' assets are those of all. Only objects that
    are fixed in the same pose in *every* type stay fixed; the others are objects like any other, in any slot.

    Args:
        types: at least one scene type or name.
        name: of the union; the names joined by ``+`` when None. It is not registered: files that name it need
            :func:`~scene_envs.scene_types.register_scene_type`.

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


def to_union(batch: SceneBatch, union: SceneType) -> SceneBatch:
    """The same scenes in the categories of ``union``, with empty slots added up to its number.

    Args:
        batch: B scenes of a type whose assets ``union`` has.
        union: of :func:`union_scene_type`, or any scene type with those assets.

    Raises:
        InvalidInputError: an asset that ``union`` lacks.
    """
    return _recategorise(batch, union).with_slots(max(union.slots, batch.tensor.shape[1]))


def from_union(batch: SceneBatch, scene_type: str | SceneType) -> SceneBatch:
    """Scenes of a union as scenes of one of its types; the inverse of :func:`to_union`.

    Fixed objects move to the first slots. Scenes keep all slots, however many the type has.

    Raises:
        InvalidInputError: a scene holds an asset that the scene type lacks, or a fixed object stands elsewhere.
    """
    return place_fixed(_recategorise(batch, get_scene_type(scene_type)), tolerance=torch.inf)


def union_normalizer(normalizers: Sequence[Normalizer], union: SceneType) -> Normalizer:
    """The normalizer of ``union`` whose range covers those of all ``normalizers`` of its types.

    Poses take the widest range of any; a pose feature is constant when it is in all of them, at the same value.
    One-hots take [0, 1].
    """
    if not normalizers:
        raise InvalidInputError("a union's normalizer needs at least one normalizer, got none")
    low, high = torch.zeros(union.features), torch.ones(union.features)
    low[:12] = torch.stack([n.input_min[:12] for n in normalizers]).amin(dim=0)
    high[:12] = torch.stack([n.input_max[:12] for n in normalizers]).amax(dim=0)
    return Normalizer.from_range(low, high)


def _recategorise(batch: SceneBatch, target: SceneType) -> SceneBatch:
    source = batch.scene_type
    known = {name: index for index, name in enumerate(target.assets)}
    table = torch.tensor([known.get(name, -1) for name in source.assets] + [target.num_assets])
    categories = table[batch.categories]
    if bool((categories < 0).any()):
        scene, slot = torch.nonzero(categories < 0)[0].tolist()
        asset = source.assets[int(batch.categories[scene, slot])]
        raise InvalidInputError(f"scene {scene} holds {asset!r}, which scene type {target.name!r} does not have")
    return SceneBatch.from_parts(batch.translations, batch.rotations, categories, target)
