"""Safe reading of PyTorch Lightning checkpoints.

Only tensors, numbers, strings and containers are read. Every other object in the file becomes an inert placeholder, so
nothing in it is run.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import torch

from scene_envs.errors import CorruptFileError, InvalidInputError


def read_lightning(file: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a Lightning checkpoint: tensors and plain data; everything else is a placeholder.

    Raises:
        InvalidInputError: no such file.
        CorruptFileError: not a checkpoint, or without a ``state_dict``.
    """
    path = Path(file)
    if not path.is_file():
        raise InvalidInputError(f"no checkpoint at {str(file)!r}")
    try:
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            content = torch.load(path, map_location="cpu", weights_only=False, pickle_module=_Inert)
    except Exception as error:  # a damaged file may raise any error; torch's message would advise to run its code
        raise CorruptFileError(
            f"{str(file)!r} is truncated or not a checkpoint of PyTorch ({type(error).__name__})"
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), Mapping):
        raise CorruptFileError(f"{str(file)!r} is not a Lightning checkpoint: it has no 'state_dict'")
    return content


class _Placeholder:
    """Stands for an object that is not read; takes anything and does nothing."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __setstate__(self, _: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> _Placeholder:
        return self

    def append(self, _: Any) -> None:
        pass

    def extend(self, _: Any) -> None:
        pass

    def __setitem__(self, _: Any, __: Any) -> None:
        pass


_ALLOWED = {
    ("collections", "OrderedDict"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch", "Size"),
    ("torch", "device"),
} | {
    ("torch", f"{kind}Storage")
    for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
}


class _Inert:
    """A pickle module for ``torch.load`` that builds tensors and plain containers, and placeholders for the rest."""

    class Unpickler(pickle.Unpickler):
        """Finds no class but those of tensors."""

        def find_class(self, module: str, name: str) -> Any:
            """The class if it is harmless; else the placeholder."""
            return super().find_class(module, name) if (module, name) in _ALLOWED else _Placeholder

    @classmethod
    def load(cls, file: IO[bytes], **options: Any) -> Any:
        """Object that :class:`Unpickler` reads from ``file``; torch calls it for files older than the zip format."""
        return cls.Unpickler(file, **options).load()
