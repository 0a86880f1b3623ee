"""A headless browser driven through its debugging pipe, with input events as a user's hands make them."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_PATIENCE = 90.0
"""Seconds after which an answer is given up."""
_START = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
for place, end in zip((3, 4), ends): os.dup2(end, place)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""Chromium reads commands from descriptor 3 and answers on 4."""


class Browser:
    """One page in Chromium, drawing WebGL in software.

    Args:
        profile: an empty folder.
        flags: more command-line flags.
        width, height: window size, pixels.
    """

    def __init__(self, profile: Path, *flags: str, width: int = 700, height: int = 560) -> None:
        assert CHROMIUM is not None
        commands, self._commands = os.pipe()
        self._answers, answers = os.pipe()
        words = [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader", "--disable-gpu-rasterization", "--disable-gpu-compositing",
            "--hide-scrollbars", f"--window-size={width},{height}",
            "--remote-debugging-pipe", f"--user-data-dir={profile}", *flags, "about:blank",
        ]  # fmt: skip
        starter = [sys.executable, "-c", _START, str(commands), str(answers), *words]
        self._process = subprocess.Popen(starter, pass_fds=(commands, answers), stderr=subprocess.DEVNULL)
        os.close(commands)
        os.close(answers)
        self._session, self._count, self._buffer = "", 0, b""
        self.exceptions: list[str] = []
        pages = [t for t in self.send("Target.getTargets")["targetInfos"] if t["type"] == "page"]
        self._session = self.send("Target.attachToTarget", targetId=pages[0]["targetId"], flatten=True)["sessionId"]
        self.send("Runtime.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """One command of the DevTools protocol, and its answer."""
        self._count += 1
        message: dict[str, Any] = {"id": self._count, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._commands, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive(method)
            if answer.get("method") == "Runtime.exceptionThrown":
                self.exceptions.append(json.dumps(answer["params"]["exceptionDetails"])[:500])
            if answer.get("id") == self._count:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return dict(answer["result"])

    def _receive(self, method: str) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._answers], [], [], _PATIENCE)
            part = os.read(self._answers, 1 << 16) if ready else b""
            assert part, f"no answer to {method}"
            self._buffer += part
        one, _, self._buffer = self._buffer.partition(b"\0")
        return dict(json.loads(one))

    def run(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        answer = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, f"{script}: {answer['exceptionDetails']}"
        return answer["result"].get("value")

    def open(self, page: Path, address: str = "") -> dict[str, str]:
        """Load a viewer, wait until it shows something, return :meth:`shown`."""
        self.exceptions.clear()
        self.send("Page.navigate", url="about:blank")
        self.send("Page.navigate", url=f"{page.resolve().as_uri()}{address}")
        self.wait_for("document.body && ['ready', 'text'].includes(document.body.dataset.state)")
        return self.shown()

    def wait_for(self, script: str) -> None:
        """Until a JavaScript expression is true."""
        deadline = time.monotonic() + _PATIENCE
        while not self.run(script):
            assert time.monotonic() < deadline, f"never true: {script}; exceptions: {self.exceptions}"
            time.sleep(0.05)

    def shown(self) -> dict[str, str]:
        """What the page says about itself, after drawing."""
        self.run("document.body.dataset.state === 'ready' && sceneViewer.draw()")
        return dict(self.run("({...document.body.dataset})"))

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """A mouse event: Pressed, Moved, Released or Wheel."""
        self.send("Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, **more)

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: str = "left") -> None:
        """Press, move, release; a click where both places are the same."""
        held: dict[str, Any] = {"button": button, "buttons": {"left": 1, "right": 2}[button]}
        self.mouse("Pressed", *start, clickCount=1, **held)
        if end != start:
            self.mouse("Moved", *end, **held)
        self.mouse("Released", *end, clickCount=1, button=button)

    def resize(self, width: int, height: int, sharpness: float = 1.0) -> None:
        """Another window, whose canvas has ``sharpness`` pixels per CSS pixel."""
        self.send(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=sharpness, mobile=False
        )

    def touch(self, *points: tuple[float, float], kind: str = "Move") -> None:
        """Fingers at these places: Start, Move or End."""
        fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        self.send("Input.dispatchTouchEvent", type=f"touch{kind}", touchPoints=fingers)

    def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key)

    def screenshot(self, path: Path) -> Path:
        """The window as a PNG file."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot")["data"]))
        return path

    def close(self) -> None:
        """End the browser."""
        self._session = ""
        try:
            self.send("Browser.close")
            self._process.wait(20)
        except (AssertionError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._commands)
        os.close(self._answers)
