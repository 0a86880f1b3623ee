"""Files: atomic writes, digests, the claim of a folder by one writer, tensors, pages, the cache, places of scenes.

The module does not import torch.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import json
import math
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from scene_envs.errors import CorruptFileError, InvalidInputError, StorageError

if TYPE_CHECKING:
    from jinja2 import Template
    from torch import Tensor

DIGEST = "sha256"
"""Key of a JSON file that holds the digest of all other keys and their values."""
_SEAL = "# scene-envs, sha256 of the lines below: "


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context with a temporary file to write, which is renamed to ``path`` when the block ends without an error.

    The folder is made if it is missing; in it, the file has the hidden name ``.<name>.<process>.<random>.partial``.
    When the block fails, it is removed, and a file at ``path`` stays unchanged. Raises StorageError, with file and
    remedy, where the operating system refuses to write or to rename.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     with replacing(Path(folder) / "new" / "a.txt") as partial:
    ...         _ = partial.write_text("all of it")
    ...     [path.name for path in (Path(folder) / "new").iterdir()]
    ['a.txt']
    """
    path = Path(path)
    partial = path.with_name(f".{path.name[:200]}.{os.getpid()}.{secrets.token_hex(4)}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except StorageError:
        raise
    except OSError as error:
        raise storage_error(path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def sealed(text: str) -> str:
    """YAML text after a first line that is a comment with the digest of the text.

    >>> sealed("seed: 0\\n").splitlines()[1:]
    ['seed: 0']
    """
    return f"{_SEAL}{hashlib.sha256(text.encode()).hexdigest()}\n{text}"


def read_sealed(path: str | os.PathLike[str]) -> str:
    """The text that was given to :func:`sealed` before it was written to ``path``; without a digest, as in a user's own
    file, all of it. Raises OSError, and CorruptFileError for a file that was changed or is not UTF-8.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise CorruptFileError(f"{str(path)!r} is damaged: byte {error.start} is no text") from error
    head, _, rest = text.partition("\n")
    if _SEAL.startswith(head[: len(_SEAL)]) and head and head != f"{_SEAL}{hashlib.sha256(rest.encode()).hexdigest()}":
        raise CorruptFileError(f"{str(path)!r} was cut off or changed after it was written (checksum)")
    return rest if head.startswith(_SEAL) else text


def cache_folder() -> Path:
    """Folder of what runs share: ``$SCENE_ENVS_CACHE``, else ``scene_envs`` in the user's cache folder."""
    if chosen := os.environ.get("SCENE_ENVS_CACHE"):
        return Path(chosen).expanduser()
    if os.name == "nt" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "scene_envs" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scene_envs"


def trim_folder(folder: Path, size: int) -> None:
    """Remove the files of ``folder`` that were used longest ago, until the others hold at most ``size`` bytes."""
    found = sorted(((path.stat(), path) for path in folder.glob("[!.]*")), key=lambda item: -item[0].st_mtime)
    for state, path in found:
        size -= state.st_size
        if size < 0:
            path.unlink(missing_ok=True)


def storage_error(path: str | os.PathLike[str], error: OSError) -> StorageError:
    """The error to raise when ``path`` could not be written."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    refused = error.errno in (errno.EACCES, errno.EPERM, errno.EROFS)
    reason = "the disk is full" if full else error.strerror or str(error)
    remedy = "make the folder writable, or give another output," if refused else "put that right"
    remedy = "make room" if full else remedy
    return StorageError(
        f"cannot write {str(path)!r}: {reason}; finished files are kept; {remedy} and run again to resume"
    )


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Replace the file at ``path`` by ``text`` in UTF-8; errors as for :func:`replacing`."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], content: Any, *, indent: int | None = 1) -> None:
    """Replace the file at ``path`` by ``content`` as JSON; numbers that JSON lacks become null."""
    write_text(path, json.dumps(finite(content), indent=indent, allow_nan=False) + "\n")


def with_digest(content: Mapping[str, Any]) -> dict[str, Any]:
    """``content`` as plain JSON values, with the digest of all of them under the last key, ``sha256``."""
    plain = {key: value for key, value in finite(content).items() if key != DIGEST}
    return {**plain, DIGEST: _digest_of(plain)}


def without_digest(content: Mapping[str, Any], path: str | os.PathLike[str]) -> dict[str, Any]:
    """``content`` without the digest of :func:`with_digest`; CorruptFileError, which says how to accept an edit, where
    it does not fit. Content without a digest may be written by hand and is returned unchanged.
    """
    plain = {key: value for key, value in content.items() if key != DIGEST}
    if DIGEST in content and content[DIGEST] != _digest_of(plain):
        raise CorruptFileError(
            f"{str(path)!r} was changed after it was written (checksum); copy it again, or if you edited it, remove "
            f"its key {DIGEST!r} to read it without a check"
        )
    return plain


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file, without its digest. FileNotFoundError where there is none, and a CorruptFileError for
    one that is no JSON, no mapping, or does not fit its digest.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise CorruptFileError(f"{str(path)!r} is not valid JSON ({type(error).__name__}: {error!s:.200})") from error
    if not isinstance(content, dict):
        raise CorruptFileError(f"{str(path)!r} holds no mapping")
    return without_digest(content, path)


class _Loader(yaml.SafeLoader):
    """As YAML 1.2, in which 1e-3 is a number."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_yaml(path: Path) -> Any:
    """The content of a YAML file; None for an empty one. Raises OSError, UnicodeDecodeError and yaml.YAMLError."""
    return yaml.load(path.read_text(encoding="utf-8"), _Loader)


def _digest_of(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def finite(value: Any) -> Any:
    """``value`` with mappings as dicts, sequences as lists, and None for numbers that JSON lacks.

    >>> finite({"a": (1.0, float("nan"))})
    {'a': [1.0, None]}
    """
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


LOCK = ".writer.lock"
_PARTIAL = re.compile(r"\..*?\.(?P<process>\d+)(\.\w+)?\.partial")
_held: set[Path] = set()
_guard = threading.Lock()


@contextmanager
def claimed(folder: str | os.PathLike[str], owner: str) -> Iterator[Path]:
    """Context in which this process alone writes into ``folder``, which is made if it is missing.

    The claim ends with the process, even if it is killed, and the same process may repeat it. Half-written files of
    killed processes are removed. Raises InvalidInputError where another process, named by its ``owner``, writes into
    the folder or it is a file, and StorageError where it cannot be made or written to.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as parent, claimed(Path(parent) / "run", "a test") as folder:
    ...     [path.name for path in folder.iterdir()]
    ['.writer.lock']
    """
    folder = Path(folder)
    key = Path(os.path.realpath(folder))
    with _guard:
        again = key in _held
        _held.add(key)
    if again:
        yield folder
        return
    lock = -1
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _lock(folder / LOCK, owner)
            sweep(folder)
        except (FileExistsError, NotADirectoryError):
            raise InvalidInputError(f"output={str(folder)!r} is a file, not a folder; give another") from None
        except StorageError:
            raise
        except OSError as error:
            raise storage_error(folder, error) from error
        yield folder
    finally:
        with _guard:
            _held.discard(key)
        if lock >= 0:
            with suppress(OSError):
                (folder / LOCK).unlink(missing_ok=True)
            os.close(lock)


def sweep(folder: Path) -> None:
    """Remove files that ended processes left half-written in ``folder`` and its subfolders."""
    for path in folder.rglob(".*.partial"):
        found = _PARTIAL.fullmatch(path.name)
        if found is None or int(found["process"]) == os.getpid() or not _is_alive(int(found["process"])):
            with suppress(OSError):
                path.unlink()


def _lock(path: Path, owner: str) -> int:
    """The descriptor of the locked file; the operating system releases the lock when the process ends."""
    import fcntl

    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            writer = os.pread(descriptor, 500, 0).decode(errors="replace").strip()
            os.close(descriptor)
            elsewhere = writer and f" on {socket.gethostname()}, since" not in writer
            takeover = f"; if that computer was switched off, remove {str(path)!r}" if elsewhere else ""
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise InvalidInputError(
                    f"{str(path.parent)!r} is being written by {writer or 'another process'}; wait until it is done, "
                    f"or give another output{takeover}"
                ) from None
            raise
        with suppress(FileNotFoundError):
            if os.fstat(descriptor).st_ino == os.stat(path).st_ino:  # it was not removed meanwhile
                text = f"{owner}, process {os.getpid()} on {socket.gethostname()}, since {time.strftime('%F %T')}"
                os.truncate(descriptor, 0)
                os.pwrite(descriptor, text.encode(), 0)
                return descriptor
        os.close(descriptor)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


SCENE_FILES = ("ready.safetensors", "scenes.safetensors", "best.safetensors")
"""Files of a run's folder that hold scenes; the first that exists is taken."""
_PRIORS = ("prior/config.json", "config.json")
"""Places of a prior's configuration in a folder."""


def find_scenes(path: Path) -> Path:
    """The file or folder of scenes that ``scenes=`` names; for a run's folder, the scene file in it. Raises
    InvalidInputError where ``path`` does not exist, or the folder holds a prior and no scenes.
    """
    if not os.path.exists(path):  # False also for names that the operating system does not allow
        raise InvalidInputError(
            f"scenes={str(path)[:200]!r}: no scene file, run or dataset is there; sample and generate make them"
        )
    if not path.is_dir():
        return path
    found = next((path / name for name in SCENE_FILES if (path / name).is_file()), path)
    if found == path and any((path / place).is_file() for place in _PRIORS):
        raise InvalidInputError(
            f"scenes={str(path)!r} holds a prior and no scenes; draw some, as with scene-envs sample prior={path}"
        )
    return found


def is_dataset(path: Path) -> bool:
    """Whether a path from :func:`find_scenes` is a dataset or one of its files, not a file or folder of scenes."""
    return not scene_files(path) if path.is_dir() else path.suffix in (".parquet", ".arrow")


def scene_files(folder: Path) -> list[Path]:
    """Scene files of a folder that holds no dataset, by name."""
    if any(folder.glob("*.parquet")) or any(folder.glob("*.arrow")):
        return []
    return sorted(path for path in folder.glob("[!.]*.safetensors") if path.is_file())


@cache
def page_part(package: str, name: str) -> str:
    """The text of a file in the folder of ``package``."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


@cache
def page_values(package: str, name: str) -> dict[str, Any]:
    """The mapping in a YAML file in the folder of ``package``."""
    values: dict[str, Any] = yaml.safe_load(page_part(package, name))
    return values


@cache
def page_template(package: str, name: str, *, trim_blocks: bool = False) -> Template:
    """The template in a file of ``package``, which may extend another one there. It escapes all text; its filter
    ``png`` gives a file in base 64.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=trim_blocks, keep_trailing_newline=not trim_blocks,
        loader=FunctionLoader(partial(page_part, package)),
    )  # fmt: skip
    environment.filters["png"] = lambda path: base64.b64encode(path.read_bytes()).decode("ascii")
    return environment.get_template(name)


def write_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> Path:
    """Write named tensors (of any device) and texts to one file, whole or not at all; StorageError where that fails."""
    from safetensors.torch import save

    path = Path(path)
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    kept = dict(metadata or {})
    content = _in_order(save(plain, {**kept, DIGEST: tensors_digest(plain, kept)}))
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return path


def read_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata of a file, on the CPU; another program's file, without a digest, is read as it is. Raises
    FileNotFoundError, and CorruptFileError for a file that is truncated, changed or no safetensors file.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    try:
        with safe_open(path, "pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise
    except (SafetensorError, OSError, ValueError, RuntimeError, MemoryError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:200]
        raise CorruptFileError(
            f"{str(path)!r} is truncated or not a safetensors file ({reason}); copy it again or make it anew"
        ) from error
    digest = metadata.pop(DIGEST, None)
    if digest is not None and digest != tensors_digest(tensors, metadata):
        raise CorruptFileError(
            f"{str(path)!r} is damaged: its contents are not what was written (checksum); copy it again or make it anew"
        )
    return tensors, metadata


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
