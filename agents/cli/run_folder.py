"""The folder of one command: its configuration, metrics and log."""

from __future__ import annotations

import logging
import re
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from agents.configuration.composition import check_same_keys, config_text, parse_config
from scene_envs.errors import CorruptFileError, InvalidInputError
from scene_envs.files import claimed, read_sealed, sealed, storage_error, write_json, write_text

_PACKAGES = ("scene_envs", "rewards", "agents")
_RESULTS = (
    "metrics.json",
    "checkpoint.pt",
    "metadata.json",
    "config.json",
    "tree.json",
    "best.safetensors",
    "scenes.safetensors",
    "ready.safetensors",
    "viewer.html",
)
"""Files that a command must not write over, unless they are its own."""
_PARTS = ("export.json", "search.journal", "log.csv", "real_scenes.safetensors", "prior", "clutter")
"""Partial results of a command that was ended early; they count in a folder that has the log of a command."""
_RESUMES = {
    "generate": "metadata.json",
    "pretrain": "checkpoint.pt",
    "post-train": "checkpoint.pt",
    "search": "best.safetensors",
}
"""Commands that can continue a run that was started in Python, and the file that shows that there is one."""
RESUMING = ("generate", "pretrain", "post-train", "search", "demo", "evaluate")
"""Commands that go on where an earlier one ended, and themselves compare their keys with those in the folder. Programs
whose settings have ``compares_keys`` do the same."""
_MAY_DIFFER = ("output", "workers", "device", "pictures", "open", "progress", "recipe", "reward_limits", "formats")
"""Keys that may change between a run and its repetition."""


class Run:
    """Context in which a command works: its folder exists, and what the packages log goes to stderr and ``log.txt``.

    One process writes into a folder at a time. A folder that holds results of another command, or of the same command
    with other keys, is refused. ``config.yaml`` is written when the command starts, unless an earlier run left results,
    and again when the command is done. Files that a failure left empty are removed.
    Of the processes that ``torchrun`` starts, only the first writes files and messages; the others log what fails.

    Args:
        command: the command's name.
        settings: its config, whose ``output`` is the folder.

    Attributes:
        directory: the folder.
    """

    def __init__(self, command: str, settings: Any) -> None:
        from agents.utils.process_group import is_first_process

        self.command = command
        self.settings = settings
        self.directory = Path(settings.output)
        self._is_first = is_first_process()
        self._handlers: list[logging.Handler] = []
        self._before: set[Path] = set()
        self._claim = ExitStack()

    def __enter__(self) -> Run:
        if not self._is_first:
            self.directory.mkdir(parents=True, exist_ok=True)
            return self
        self._claim.enter_context(claimed(self.directory, f"scene-envs {self.command}"))
        try:
            self._before = _empty_files(self.directory)
            if not self._holds_results():
                self.write_config()
            self._start_logging()
            self.log(f"scene-envs {self.command}")
        except BaseException as error:
            self._claim.close()
            if isinstance(error, OSError):
                raise storage_error(self.directory, error) from error
            raise
        return self

    def _holds_results(self) -> bool:
        """Whether the folder holds results of this command; refuses those of another, or of other keys."""
        found = [name for name in _RESULTS if (self.directory / name).exists()]
        writer = _writer(self.directory)
        if writer is not None and (found or writer != self.command):
            found += [name for name in _PARTS if (self.directory / name).exists()]
        if not found:
            return False
        if writer is None and _RESUMES.get(self.command) in found:
            return True
        if writer != self.command:
            other = "another program" if writer is None else f"scene-envs {writer}"
            raise InvalidInputError(f"output={str(self.directory)!r} holds {found[0]} of {other}; give another output")
        if self.command not in RESUMING and not getattr(self.settings, "compares_keys", False):
            self._check_keys()
        return True

    def _check_keys(self) -> None:
        path = self.directory / "config.yaml"
        try:
            before = parse_config(read_sealed(path), repr(str(path)))
        except OSError:
            return
        except CorruptFileError as error:
            raise CorruptFileError(
                f"{error}, so whether {str(self.directory)!r} was written with these keys cannot be told; give another "
                f"output, or remove {path.name} to write into the folder all the same"
            ) from error
        now = parse_config(config_text(self.settings), "")
        check_same_keys(self.directory, before, now, _MAY_DIFFER, type(self.settings))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self.write_config()
            elif self._is_first:
                for path in _empty_files(self.directory) - self._before:
                    with suppress(OSError):
                        path.unlink()
                with suppress(OSError):
                    ended = isinstance(error, KeyboardInterrupt)
                    self._append("ended by a signal" if ended else f"failed: {str(error) or type(error).__name__}")
        finally:
            for handler in self._handlers:
                with suppress(OSError):
                    handler.close()
                for package in _PACKAGES:
                    logging.getLogger(package).removeHandler(handler)
            self._claim.close()

    def say(self, text: str) -> None:
        """Tell the user on stdout, and keep it in the log."""
        if self._is_first:
            print(text, flush=True)
        self.log(text)

    def log(self, text: str) -> None:
        """One line into ``log.txt`` alone."""
        if self._is_first:
            self._append(text)

    def _append(self, text: str) -> None:
        with (self.directory / "log.txt").open("a", encoding="utf-8") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {text}\n")

    def write_metrics(self, metrics: Mapping[str, Any]) -> None:
        """``metrics.json``, whole or not at all; numbers that JSON lacks become null."""
        if self._is_first:
            write_json(self.directory / "metrics.json", metrics)

    def write_config(self) -> None:
        """``config.yaml`` with every key."""
        if self._is_first:
            write_text(self.directory / "config.yaml", sealed(config_text(self.settings)))

    def _start_logging(self) -> None:
        screen = logging.StreamHandler(sys.stderr)
        screen.setLevel(logging.INFO)
        screen.setFormatter(logging.Formatter("%(message)s"))
        file = logging.FileHandler(self.directory / "log.txt", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
        self._handlers = [screen, file]
        for package in _PACKAGES:
            logger = logging.getLogger(package)
            logger.setLevel(logging.DEBUG)  # details for the file alone
            for handler in self._handlers:
                logger.addHandler(handler)


def _writer(folder: Path) -> str | None:
    """The command whose log a folder holds, None where there is none."""
    with suppress(OSError), (folder / "log.txt").open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if found := re.match(r"[-0-9]+ [:0-9]+ scene-envs ([-\w]+)$", line):
                return found[1]
    return None


def _empty_files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file() and not path.stat().st_size and path.name != "log.txt"}


def fresh_directory(command: str) -> str:
    """``runs/<command>-<time>``, with a number behind it when two commands start in the same second.

    Raises:
        InvalidInputError: this is one of several processes, which need the same folder.
    """
    from agents.utils.process_group import launched_processes

    if (count := launched_processes()) > 1:
        raise InvalidInputError(
            f"the {count} processes of this run share a folder; give output=, such as runs/{command}"
        )
    base = Path("runs") / f"{command}-{time.strftime('%Y%m%d-%H%M%S')}"
    directory, number = base, 1
    while directory.exists():
        number += 1
        directory = base.with_name(f"{base.name}-{number}")
    return str(directory)
