"""Import of a large file as an asset in a process that is ended when the time of the import is over.

``python -m scene_envs.assets.importing.process REQUEST RESULT`` is that process.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scene_envs.assets.importing.entries import AssetEntry
from scene_envs.assets.importing.limits import seconds_left, timed, too_slow
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError, SceneEnvsError
from scene_envs.files import replacing
from scene_envs.worker_processes import module_command, module_environment

if TYPE_CHECKING:
    from scene_envs.assets.base import Asset
    from scene_envs.assets.importing.report import AssetReport

_ERRORS = {kind.__name__: kind for kind in (CorruptFileError, InvalidInputError, MissingDependencyError)}


def build_apart(path: Path, entry: AssetEntry) -> tuple[Asset, AssetReport]:
    """As :func:`~scene_envs.assets.importing.build.build_asset`, in a process of its own.

    Raises:
        InvalidInputError: the time of the import is over, or the process crashed.
        SceneEnvsError: what ``build_asset`` raises.
    """
    left = seconds_left()
    with tempfile.TemporaryDirectory() as folder:
        request, result = Path(folder) / "request", Path(folder) / "result"
        request.write_bytes(pickle.dumps((path, entry)))
        command = module_command("scene_envs.assets.importing.process", str(request), str(result))
        child = subprocess.Popen(
            command,
            env=module_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,  # so that what it starts, such as CoACD, is ended with it
        )
        try:
            _, told = child.communicate(timeout=left)
        except subprocess.TimeoutExpired:
            raise too_slow("") from None
        finally:
            with suppress(OSError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        if not result.is_file():
            reason = told.decode(errors="replace").strip().rpartition("\n")[2][:300]
            raise InvalidInputError(
                f"{path}: the import ended with status {child.returncode}{reason and ': '}{reason}; simplify the file"
            )
        outcome: Any = pickle.loads(result.read_bytes())  # written by this package, in a folder of ours
    if isinstance(outcome, tuple) and isinstance(outcome[0], str):
        raise _ERRORS.get(outcome[0], InvalidInputError)(outcome[1])
    return outcome  # type: ignore[no-any-return]


def main(request: str, result: str) -> None:
    """Build the asset that ``request`` names, and write it, or the error, to ``result``."""
    from scene_envs.assets.importing.build import build_asset

    path, entry = pickle.loads(Path(request).read_bytes())
    outcome: Any
    try:
        with timed(path):
            outcome = build_asset(path, entry)
    except SceneEnvsError as error:
        outcome = (type(error).__name__, str(error))
    with replacing(result) as partial:
        partial.write_bytes(pickle.dumps(outcome))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
