"""Rewards in a user's own file, named ``PATH.py:NAME``."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from scene_envs.errors import InvalidInputError, RewardError

_LOCAL = re.compile(r"(?P<path>.+\.py):(?P<name>[A-Za-z_]\w*)", re.DOTALL)
_allowed: set[Path] = set()


def is_local(reward: Any) -> bool:
    """Whether a name of a reward names a function or class in a file.

    >>> is_local("./my_rewards.py:clutter"), is_local("clutter")
    (True, False)
    """
    return isinstance(reward, str) and _LOCAL.fullmatch(reward) is not None


def local_files(reward: Any) -> list[Path]:
    """The files whose code a reward would run, those of its parts included."""
    found = (_LOCAL.fullmatch(name) for name in names_in(reward))
    return sorted({Path(match["path"]).expanduser().resolve() for match in found if match})


def names_in(reward: Any) -> Iterator[str]:
    """All texts in a reward's name or mapping that may name a reward."""
    if isinstance(reward, str):
        yield reward
    elif isinstance(reward, Mapping):
        for value in reward.values():
            yield from names_in(value)
    elif isinstance(reward, list | tuple):
        for value in reward:
            yield from names_in(value)


def allow_local_rewards(path: str | Path) -> None:
    """Let ``reward="PATH.py:NAME"`` run the file ``path``. Every other file is refused."""
    _allowed.add(Path(path).expanduser().resolve())


def allowed_files() -> list[Path]:
    """The files that may be run."""
    return sorted(_allowed)


def load_local(reward: str) -> Callable[..., Any]:
    """The function or class that ``PATH.py:NAME`` names; runs the file once per process.

    Raises:
        InvalidInputError: the file was not allowed, does not exist, or has no callable of that name.
        RewardError: the file cannot be run.
    """
    match = _LOCAL.fullmatch(reward)
    assert match is not None
    path = Path(match["path"]).expanduser().resolve()
    if path not in _allowed:
        raise InvalidInputError(
            f"reward {reward!r} would run the file {str(path)!r}, which was not allowed: give --allow-local on the "
            "command line, or call rewards.allow_local_rewards(path) in Python"
        )
    if not path.is_file():
        raise InvalidInputError(f"reward {reward!r}: there is no file {str(path)!r}")
    key = f"local_rewards_{hashlib.blake2b(str(path).encode(), digest_size=8).hexdigest()}"
    if key not in sys.modules:
        spec = spec_from_file_location(key, path)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[key] = module
        try:
            spec.loader.exec_module(module)
        except KeyboardInterrupt:
            del sys.modules[key]
            raise
        except BaseException as error:
            del sys.modules[key]
            raise RewardError(
                f"reward {reward!r}: the file cannot be run: {type(error).__name__}: {str(error)[:300]}"
            ) from error
    found = getattr(sys.modules[key], match["name"], None)
    if not callable(found):
        raise InvalidInputError(f"reward {reward!r}: {str(path)!r} has no function or class {match['name']!r}")
    return found  # type: ignore[no-any-return]
