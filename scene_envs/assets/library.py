"""Asset library: users' assets from their folders, and the built-in ones."""

from __future__ import annotations

import os
from collections.abc import Sequence

from scene_envs.assets.base import AssetLibrary
from scene_envs.assets.built_in import build_asset, list_assets
from scene_envs.assets.importing.user_library import find_asset, folder_index
from scene_envs.errors import unknown_name


def get_library(names: Sequence[str], folders: Sequence[str | os.PathLike[str]] = ()) -> AssetLibrary:
    """The assets called ``names``, in this order; each is built once per process.

    Args:
        names: asset names in category order.
        folders: of users' own assets, searched in this order before the built-in ones.

    Raises:
        UnknownNameError: neither a folder nor a recipe has that name; the nearest known one is offered.
        InvalidInputError: a folder or one of its entries is wrong.
        CorruptFileError: a file of a folder cannot be read.
    """
    if not folders:
        return AssetLibrary(tuple(build_asset(name) for name in names))
    own = [name for folder in folders for name in folder_index(folder).names]
    for name in names:
        if name not in own and name not in list_assets():
            raise unknown_name("asset", name, [*own, *list_assets()])
    return AssetLibrary(tuple(find_asset(name, folders) or build_asset(name) for name in names))
