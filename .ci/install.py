"""Installation with pip for slow networks: shows progress, tries again after a lost connection, repairs after a kill.

    .venv/bin/python .ci/install.py [arguments of pip install]

Passes on what pip says. While pip is silent, prints how much of the current file has come, or how many packages are
installed: at a terminal one line that changes, and else a line every ten seconds. Exit status: that of pip, 1 where the
network failed, 130 after an interrupt.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from collections.abc import Sequence
from pathlib import Path

PIP = (sys.executable, "-m", "pip")
RESUMING_PIP = (25, 1)
"""The first version of pip that goes on in the middle of a file."""
PAUSES = (5.0, 10.0, 20.0)
"""Seconds before each further try."""
NETWORK = re.compile(
    r"connection|timed out|TimeoutError|IncompleteRead|ProtocolError|not enough bytes|name resolution|"
    r"Wheel .* is invalid|network is unreachable|HTTP error 5|SSLError|RemoteDisconnected|do not match the hash",
    re.IGNORECASE,
)
"""Words of pip about a network that failed."""
DOWNLOAD = re.compile(r"\s*(?:Downloading|Resuming download) (?P<url>\S+) \((?:.*/)?(?P<size>[\d.]+ [kMG]?B)\)")


class Pip:
    """One run of pip, whose output is passed on.

    Args:
        arguments: of ``pip install``.
        scratch: folder for its temporary files, where downloads grow.
        packages: folder where it installs.
        silence: seconds without a word after which progress is printed.
    """

    def __init__(self, arguments: Sequence[str], scratch: Path, packages: Path, silence: float) -> None:
        self.scratch, self.packages, self.silence = scratch, packages, silence
        resume = ("--resume-retries", "20") if pip_version(packages) >= RESUMING_PIP else ()
        quiet = ("--disable-pip-version-check", "--progress-bar", "off")
        self.command = [*PIP, "install", *quiet, *resume, *arguments]
        self.said: list[str] = []
        self.errors: list[str] = []
        self._file, self._size, self._warning, self._shown, self._expected, self._before = "", "", "", "", 0, 0

    def run(self) -> int:
        """Exit status of pip."""
        environment = {**os.environ, "TMPDIR": str(self.scratch), "PYTHONUNBUFFERED": "1"}
        process = subprocess.Popen(
            self.command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=environment
        )
        lines: queue.Queue[bytes | None] = queue.Queue()

        def read() -> None:
            assert process.stdout is not None
            for line in process.stdout:
                lines.put(line)
            lines.put(None)

        threading.Thread(target=read, daemon=True).start()
        last = time.monotonic()
        try:
            while True:
                try:
                    line = lines.get(timeout=self.silence)
                except queue.Empty:
                    self._show(self._progress(time.monotonic() - last))
                    continue
                if line is None:
                    return process.wait()
                last = time.monotonic()
                self._take(line.decode(errors="replace").rstrip())
        finally:
            self._show("")
            if process.poll() is None:
                process.terminate()
                process.wait()

    def network_reason(self) -> str:
        """The last words of pip about the network; empty where it says nothing of it in the end."""
        found = [line.strip(" ×") for line in (*self.said[-10:], *self.errors) if NETWORK.search(line)]
        return reason_of(found[-1]) if found else ""

    def _take(self, line: str) -> None:
        if self.errors or line.strip().lower().startswith("error:"):  # shown in the end, unless it is the network
            self.errors.append(line)
            return
        self.said.append(line)
        if "WARNING: Retrying (Retry(" in line:
            line = f"  {reason_of(line)}; pip tries again"
            if line == self._warning:
                return
            self._warning = line
        if found := DOWNLOAD.match(line):
            self._file, self._size = found["url"].rpartition("/")[2].partition("-")[0], found["size"]
        elif line.strip():
            self._file = ""
        if line.startswith("Installing collected packages: "):
            self._expected, self._before = line.count(",") + 1, len(_installed(self.packages))
        self._show("")
        print(line, flush=True)

    def _progress(self, seconds: float) -> str:
        if self._expected:
            done = max(0, len(_installed(self.packages)) - self._before)
            return f"  {done} of {self._expected} packages installed, {seconds:.0f} s at the next"
        if self._file:
            with contextlib.suppress(OSError):  # pip may have just moved it
                sizes = [file.stat().st_size for file in self.scratch.glob(f"pip-unpack-*/{self._file}*")]
                return f"  {self._file}: {max(sizes, default=0) / 1e6:.1f} of {self._size}, {seconds:.0f} s"
        return f"  still at it, {seconds:.0f} s"

    def _show(self, text: str) -> None:
        """Print progress, at a terminal in place of the last."""
        if sys.stdout.isatty():
            text = text[: shutil.get_terminal_size().columns - 1]
            print(f"\r{' ' * len(self._shown)}\r{text}", end="", flush=True)
            self._shown = text
        elif text:
            print(text, flush=True)


def install(
    arguments: Sequence[str], scratch: Path, packages: Path, pauses: Sequence[float] = PAUSES, silence: float = 0.0
) -> int:
    """Install with pip, again after each pause while the network fails; returns the exit status."""
    for pause in (*pauses, None):
        pip = Pip(arguments, scratch, packages, silence or (1.0 if sys.stdout.isatty() else 10.0))
        status = pip.run()
        reason = pip.network_reason() if status else ""
        if not reason:
            print(*pip.errors, sep="\n", end="\n" * bool(pip.errors), flush=True)
            return status
        if pause is not None:
            print(f"The network failed: {reason}\nTrying again in {pause:g} s ...", flush=True)
            time.sleep(pause)
    print(
        f"The network failed {len(pauses) + 1} times: {reason}\nThe same command goes on; files that came stay in "
        "pip's cache.",
        file=sys.stderr,
    )
    return 1


def reason_of(line: str) -> str:
    """The reason in a line of pip about a broken connection.

    >>> reason_of("after connection broken by 'NewError(Pool(port=80): No route)': /simple/a/")
    'No route'
    """
    inner = line.partition("broken by '")[2].rpartition("': /")[0]
    return (inner.rpartition("): ")[2].strip("\"')") or line.strip())[-200:]


def repair(packages: Path) -> list[str]:
    """Remove the records of packages whose installation was killed, so that pip installs them again; returns them.

    pip writes ``INSTALLER`` last. Before that, programs of the package may be missing.
    """
    finished = _installed(packages)
    unfinished = [folder for folder in sorted(packages.glob("*.dist-info")) if folder not in finished]
    for folder in (*unfinished, *packages.glob("~*")):  # ~: old files that pip had moved aside
        shutil.rmtree(folder)
    return [folder.name.removesuffix(".dist-info") for folder in unfinished]


def _installed(packages: Path) -> list[Path]:
    return [file.parent for file in packages.glob("*.dist-info/INSTALLER")]


def pip_version(packages: Path) -> tuple[int, ...]:
    """Version of the pip in a folder of packages; empty for none."""
    names = [folder.name for folder in packages.glob("pip-*.dist-info")]
    return tuple(map(int, re.findall(r"\d+", names[0]))) if names else ()


def main(arguments: Sequence[str]) -> int:
    """Repair what is there, get a pip that goes on in the middle of a file, install."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    packages, scratch = Path(sysconfig.get_path("purelib")), Path(sys.prefix) / "tmp"
    shutil.rmtree(scratch, ignore_errors=True)  # of a run that was killed
    scratch.mkdir()
    for name in repair(packages):
        print(f"{name} was not installed to its end; installing it again.", flush=True)
    try:
        if pip_version(packages) < RESUMING_PIP:
            constraints = arguments[:2] if arguments[:1] == ["-c"] else []
            install([*constraints, "pip>=25.1"], scratch, packages)  # without it, files begin anew after a failure
        return install(arguments, scratch, packages)
    except KeyboardInterrupt:
        print("\nInterrupted; the same command goes on.", file=sys.stderr)
        return 130
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
