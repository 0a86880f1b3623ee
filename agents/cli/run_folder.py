"""The folder of one command: its configuration, metrics and log."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from agents.configuration.tree import config_text
from agents.utils.process_group import is_first_process
from scene_envs.errors import InvalidInputError
from scene_envs.files import write_json, write_text

_PACKAGES = ("scene_envs", "rewards", "agents")


class Run:
    """Context in which a command works: its folder exists, and what the packages log goes to stderr and ``log.txt``.

    ``config.yaml`` is written when the command starts, unless an earlier run left one, and again when it is done.
    Of the processes that ``torchrun`` starts, the first alone writes and speaks; the others log what fails.

    Args:
        command: the command's name.
        settings: its config, whose ``output`` is the folder.

    Attributes:
        directory: the folder.
    """

    def __init__(self, command: str, settings: Any) -> None:
        self.command = command
        self.settings = settings
        self.directory = Path(settings.output)
        self._is_first = is_first_process()
        self._handlers: list[logging.Handler] = []

    def __enter__(self) -> Run:
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InvalidInputError(f"output={str(self.directory)!r} is a file, not a folder; give another") from None
        if not self._is_first:
            return self
        if not (self.directory / "config.yaml").exists():
            self._write_config()
        self._start_logging()
        self.log(f"scene-envs {self.command}")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self._write_config()
        else:
            self._append(f"failed: {error or kind}")
        for handler in self._handlers:
            handler.close()
            for package in _PACKAGES:
                logging.getLogger(package).removeHandler(handler)

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

    def _write_config(self) -> None:
        if self._is_first:
            write_text(self.directory / "config.yaml", config_text(self.settings))

    def _start_logging(self) -> None:
        screen = logging.StreamHandler(sys.stderr)
        screen.setFormatter(logging.Formatter("%(message)s"))
        file = logging.FileHandler(self.directory / "log.txt", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
        self._handlers = [screen, file]
        for package in _PACKAGES:
            logger = logging.getLogger(package)
            logger.setLevel(logging.INFO)
            for handler in self._handlers:
                logger.addHandler(handler)


def fresh_directory(command: str) -> str:
    """``runs/<command>-<time>``, with a number behind it when two commands start in the same second."""
    base = Path("runs") / f"{command}-{time.strftime('%Y%m%d-%H%M%S')}"
    directory, number = base, 1
    while directory.exists():
        number += 1
        directory = base.with_name(f"{base.name}-{number}")
    return str(directory)
