"""Registry of scene types: built-in ones, those of installed packages, users' own, and unions of them."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.errors import InvalidInputError
from scene_envs.registry import Registry
from scene_envs.scene_types.base import SceneType
from scene_envs.scene_types.built_in import BUILT_IN
from scene_envs.scene_types.unions import union_of

PLUGINS = "scene_envs.scene_types"
"""Entry-point group of modules that register scene types and their grammars when they are imported."""

_SCENE_TYPES = Registry("scene type", PLUGINS, {scene_type.name: scene_type for scene_type in BUILT_IN})


def register_scene_type(scene_type: SceneType) -> SceneType:
    """Make ``scene_type`` available by name everywhere; the same name again replaces it."""
    _SCENE_TYPES[scene_type.name] = scene_type
    if scene_type.asset_folders:
        from scene_envs.assets.library import know_folders

        know_folders(scene_type.asset_folders)
    return scene_type


def get_scene_type(name: str | SceneType) -> SceneType:
    """The scene type called ``name``; names joined by ``+`` are their union.

    Raises:
        UnknownNameError: no scene type has that name; the nearest known one is offered.
        InvalidInputError: ``name`` is neither text nor a scene type.

    >>> get_scene_type("dimsum_table+pantry_shelf").slots
    61
    """
    if isinstance(name, SceneType):
        return name
    if not isinstance(name, str):
        raise InvalidInputError(f"a scene type or its name is needed, got a {type(name).__name__}")
    if name not in _SCENE_TYPES and "+" in name:
        return union_scene_type(name.split("+"), name)
    return _SCENE_TYPES[name]


def list_scene_types() -> list[str]:
    """Names of all registered scene types, those of installed packages included, sorted."""
    return _SCENE_TYPES.names()


def union_scene_type(types: Sequence[str | SceneType], name: str | None = None) -> SceneType:
    """The scene type that holds the scenes of all ``types``.

    The union has the assets of all types, sorted by name, the largest number of slots, and the box around all
    workspaces. Assets that are welded in one type are welded in the union. Its folders of users' assets are those of
    all types. Only objects that are fixed in the same pose in *every* type stay fixed; the others may be in any slot.

    Args:
        types: One or more scene types or names.
        name: Name of the union. None joins the names of the types by ``+``, which :func:`get_scene_type` resolves.
            Another name is not registered: files that hold it need
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
    return union_of(members, name or "+".join(dict.fromkeys(member.name for member in members)))


def members_of(scene_type: SceneType) -> tuple[SceneType, ...]:
    """The scene types that the name of a union lists; ``scene_type`` itself where it is no union.

    The members are found only where all of them are registered and together have the assets of the union.

    >>> [member.name for member in members_of(get_scene_type("dimsum_table+pantry_shelf"))]
    ['dimsum_table', 'pantry_shelf']
    """
    names = scene_type.name.split("+")
    if len(names) < 2 or any(name not in _SCENE_TYPES for name in names):
        return (scene_type,)
    members = tuple(get_scene_type(name) for name in names)
    return members if {a for member in members for a in member.assets} == set(scene_type.assets) else (scene_type,)
