"""Signals that end a command: SIGTERM as an exception, and SIGTERM and Ctrl-C delayed to the end of a step."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

logger = logging.getLogger(__name__)

_GRACE_SECONDS = 15
"""Seconds that a step may take to end before the signal ends it."""


class Terminated(KeyboardInterrupt):
    """The process was asked to end by SIGTERM; handled like Ctrl-C."""


@contextmanager
def terminable(received: list[int] | None = None) -> Iterator[None]:
    """Context in which SIGTERM raises :class:`Terminated`; outside the main thread it changes nothing. Each signal's
    number is appended to ``received``, which shows it where compiled code, such as the import of an extension module,
    turns the exception into another error.
    """

    def note_and_raise(number: int, frame: FrameType | None) -> None:
        if received is not None:
            received.append(number)
        _raise(number, frame)

    with _handling({signal.SIGTERM: note_and_raise}):
        yield


@contextmanager
def finishing_steps() -> Iterator[Ending]:
    """Context in which SIGINT and SIGTERM wait for the end of a step, at most 15 s; a second one does not wait. Yields
    an :class:`Ending`, to be called after each step. If a signal is ``pending``, save the state before the call.
    """
    end = Ending()
    with _handling({signal.SIGINT: end.note, signal.SIGTERM: end.note, signal.SIGALRM: end.late}):
        try:
            yield end
        finally:
            if end.pending:
                signal.alarm(0)


class Ending:
    """A signal that waits for the end of a step; a call after the step raises the exception of that signal."""

    def __init__(self) -> None:
        self.number = 0

    @property
    def pending(self) -> bool:
        """Whether a signal waits."""
        return self.number != 0

    def note(self, number: int, frame: FrameType | None) -> None:
        """Remember the first signal, raise the second."""
        if self.number:
            _raise(number, frame)
        self.number = number
        signal.alarm(_GRACE_SECONDS)
        logger.info("finishing this step and saving; the same signal again ends at once")

    def late(self, number: int, frame: FrameType | None) -> None:
        """Raise the exception of the waiting signal, as the step took too long."""
        _raise(self.number, frame)

    def __call__(self, in_another_process: bool = False) -> None:
        """Raise if a signal waits; one that waits ``in_another_process`` of the run counts as SIGTERM."""
        if self.number or in_another_process:
            _raise(self.number or signal.SIGTERM, None)


def _raise(number: int, frame: FrameType | None) -> None:
    raise Terminated if number == signal.SIGTERM else KeyboardInterrupt


@contextmanager
def _handling(handlers: dict[signal.Signals, Any]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
