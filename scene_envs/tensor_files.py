"""Safetensors files with a digest of their contents, verified when they are read."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from scene_envs.errors import CorruptFileError
from scene_envs.files import replacing

DIGEST = "sha256"
"""Key of the digest in a file's metadata; also the suffix of a second file with the digest of all its bytes."""


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> Path:
    """Write tensors to one file, whole or not at all.

    Args:
        path: Path of the file.
        tensors: Tensors by name, on any device.
        metadata: Texts by name, kept in the same file.

    Raises:
        StorageError: the file cannot be written; nothing is left of it.
    """
    from safetensors.torch import save

    path = Path(path)
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    kept = dict(metadata or {})
    content = _in_order(save(plain, {**kept, DIGEST: tensors_digest(plain, kept)}))
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    path.with_name(f"{path.name}.{DIGEST}").unlink(missing_ok=True)  # the digest of the replaced file
    return path


def read_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a file, on the CPU; a file of earlier versions, without a digest, is read as it is.

    Raises:
        FileNotFoundError: the file does not exist.
        CorruptFileError: the file is truncated, no safetensors file, or was changed.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    check_digest_file(path)
    try:
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError, ValueError, RuntimeError, MemoryError) as error:
        raise CorruptFileError(
            f"{str(path)!r} is truncated or not a safetensors file ({_short(error)}); copy it again or make it anew"
        ) from error
    digest = metadata.pop(DIGEST, None)
    if digest is not None and digest != tensors_digest(tensors, metadata):
        raise CorruptFileError(_changed(path))
    return tensors, metadata


def check_digest_file(path: Path) -> None:
    """Verify a file against the digest in the file ``<name>.sha256`` in its folder, if there is one.

    Raises:
        CorruptFileError: the digests differ.
    """
    digest_file = path.with_name(f"{path.name}.{DIGEST}")
    if not digest_file.is_file() or not path.is_file():
        return
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found not in digest_file.read_text(encoding="utf-8", errors="replace").split():
        raise CorruptFileError(_changed(path))


def _in_order(content: bytes) -> bytes:
    """The same file with its header sorted: equal contents make equal bytes."""
    size = int.from_bytes(content[:8], "little")
    header = json.dumps(json.loads(content[8 : 8 + size]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


def tensors_digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None) -> str:
    """SHA-256 of tensors on the CPU, by name, and of their metadata."""
    import torch

    digest = hashlib.new(DIGEST, json.dumps(sorted((metadata or {}).items())).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        digest.update(tensor.contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _changed(path: Path) -> str:
    return f"{str(path)!r} is damaged: its contents are not what was written (checksum); copy it again or make it anew"


def _short(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
