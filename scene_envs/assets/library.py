"""Libraries by name: users' assets from their folders, and the built-in ones, each made by a recipe."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cache

import numpy as np

from scene_envs.assets.base import Asset, AssetLibrary
from scene_envs.assets.importing.user_library import folder_index
from scene_envs.assets.recipes import RECIPES
from scene_envs.assets.shapes import mass_properties
from scene_envs.errors import InvalidInputError, UnknownNameError, unknown_name

_known_folders: dict[str, None] = {}
"""Folders of the scene types that were registered, in that order."""


def list_assets() -> list[str]:
    """Names of all assets that can be built, sorted."""
    return sorted(RECIPES)


def know_folders(folders: Sequence[str | os.PathLike[str]]) -> None:
    """Make :func:`get_library` search these folders too, after the built-in assets."""
    _known_folders.update(dict.fromkeys(map(str, folders)))


def get_library(names: Sequence[str], folders: Sequence[str | os.PathLike[str]] = ()) -> AssetLibrary:
    """The assets called ``names``, in this order, which is that of categories; each is built once per process.

    ``folders`` are those of users' own assets, searched in this order before the built-in ones. The folders of
    registered scene types are searched last.

    Raises:
        UnknownNameError: neither a folder nor a recipe has that name; the nearest known one is offered.
        InvalidInputError: a folder or one of its entries is wrong, or ``names`` is no list of names.
        CorruptFileError: a file of a folder cannot be read.
    """
    if isinstance(names, str | os.PathLike):
        raise InvalidInputError(
            f"get_library takes a list of asset names, as in [{str(names)!r}]; load_library(folder) reads a folder"
        )
    own = [name for folder in folders for name in folder_index(folder).names]
    return AssetLibrary(tuple(_find(name, own, folders) for name in names))


def _find(name: str, own: Sequence[str], folders: Sequence[str | os.PathLike[str]]) -> Asset:
    """The asset called ``name``; ``own`` are the names in ``folders``."""
    if name in own:
        places: tuple[str | os.PathLike[str], ...] = tuple(folders)
    elif name in RECIPES:
        return _built_in(name)
    else:
        places = tuple(folder for folder in _known_folders if os.path.isdir(folder))
    for index in map(folder_index, places):
        for entry in index.entries:
            if entry.name == name:
                return index.build(entry)[0]
    known = [known for folder in places for known in folder_index(folder).names]
    error = unknown_name("asset", name, [*own, *known, *list_assets()])
    raise UnknownNameError(f"{error} Assets of your own: give the folder in folders=, or register their scene type.")


@cache
def _built_in(name: str) -> Asset:
    """The asset that the recipe called ``name`` makes, built once per process."""
    entry = RECIPES[name]
    model = entry.recipe()
    mass, center, inertia = mass_properties(model.fine, entry.mass)
    return Asset(
        name=name,
        display_name=entry.display_name,
        plural=entry.plural,
        mass=mass,
        center_of_mass=center,
        inertia=inertia if mass > 0 else np.zeros((3, 3)),
        visual=model.visual,
        fine=tuple(model.fine),
        coarse=tuple(model.coarse),
        color=entry.color,
        static=mass == 0,
    )
