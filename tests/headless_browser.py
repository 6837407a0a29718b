"""Drive a headless Chromium by the DevTools protocol over a pipe: no package is needed."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_ANSWER_S = 60.0


def browser_path() -> str:
    """Return the path of a Chromium; skip the test where there is none."""
    for name in _NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip(f"no browser: expected one of {', '.join(_NAMES)} in PATH")


class Page:
    """A tab of the browser."""

    def __init__(self, send: Callable[..., dict[str, Any]], session: str) -> None:
        self._send, self._session = send, session

    def command(self, method: str, **parameters: object) -> dict[str, Any]:
        return self._send(method, parameters, self._session)

    def open(self, path: Path, width: int = 1400, height: int = 1000, *, script: bool = True):
        """Show a file at a window size, with or without JavaScript."""
        self.command("Page.enable")
        self.command("Runtime.enable")
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        self.command("Emulation.setScriptExecutionDisabled", value=not script)
        self.command("Page.navigate", url=path.resolve().as_uri())
        self.wait_for("document.readyState === 'complete'")

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.command(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Wait until a JavaScript expression is true."""
        end = time.monotonic() + _ANSWER_S
        while not self.value(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.02)

    def mouse(self, kind: str, x: float, y: float, **more: object) -> None:
        self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def move(self, x: float, y: float) -> None:
        """Move the mouse."""
        self.mouse("mouseMoved", x, y)

    def drag(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Press the left button, move in steps, release it."""
        self.move(x0, y0)
        self.mouse("mousePressed", x0, y0, button="left", buttons=1, clickCount=1)
        for k in range(1, 6):
            x, y = x0 + (x1 - x0) * k / 5, y0 + (y1 - y0) * k / 5
            self.mouse("mouseMoved", x, y, button="left", buttons=1)
        self.mouse("mouseReleased", x1, y1, button="left", clickCount=1)

    def double_click(self, x: float, y: float) -> None:
        """Click twice."""
        for count in (1, 2):
            self.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=count)
            self.mouse("mouseReleased", x, y, button="left", clickCount=count)

    def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.command("Input.dispatchKeyEvent", type=kind, key=key)

    def screenshot(self, path: Path, whole: bool = True) -> None:
        """Save a picture of the page."""
        size = self.command("Page.getLayoutMetrics")["cssContentSize"]
        clip = {"clip": {**size, "scale": 1}, "captureBeyondViewport": True} if whole else {}
        data = self.command("Page.captureScreenshot", format="png", **clip)["data"]
        path.write_bytes(base64.b64decode(data))


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Start a browser with an empty profile; end it after the `with` body."""
    to_child, from_us = os.pipe()
    from_child, to_us = os.pipe()

    def place() -> None:  # the browser reads from 3 and writes to 4
        reading, writing = os.dup(to_child), os.dup(to_us)
        os.dup2(reading, 3)
        os.dup2(writing, 4)

    process = subprocess.Popen(
        [
            browser_path(), "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--remote-debugging-pipe", "--no-first-run", f"--user-data-dir={profile}",
            "about:blank",
        ],
        preexec_fn=place, pass_fds=(3, 4),  # noqa: PLW1509 - it only duplicates two descriptors
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(to_child)
    os.close(to_us)
    try:
        with os.fdopen(from_us, "wb", 0) as sending, os.fdopen(from_child, "rb") as receiving:
            yield _first_page(sending, receiving)
    finally:
        process.kill()
        process.wait()


def _first_page(sending: Any, receiving: Any) -> Page:
    number, rest = 0, b""

    def send(method: str, parameters: dict[str, Any], session: str = "") -> dict[str, Any]:
        nonlocal number, rest
        number += 1
        message = {"id": number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        sending.write(json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in rest:
                part = receiving.read1(1 << 16)
                if not part:
                    raise EOFError("the browser ended")
                rest += part
            text, _, rest = rest.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    target = send("Target.createTarget", {"url": "about:blank"})["targetId"]
    session = send("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
    return Page(send, session)
