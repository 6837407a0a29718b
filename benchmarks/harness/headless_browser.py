"""Drive a headless Chromium by the DevTools protocol over a pipe: no package is needed."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
_ANSWER_S, _POLL_S = 60.0, 0.002
_READS, _WRITES = 3, 4


def find_browser() -> str | None:
    """Return the path of a Chromium, None where there is none."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


class Page:
    """A tab of the browser, and the errors in its console."""

    def __init__(
        self, send: Callable[..., dict[str, Any]], session: str, errors: list[str]
    ) -> None:
        self._send, self._session = send, session
        self.errors = errors
        for domain in ("Page", "Runtime", "Log"):
            self.command(f"{domain}.enable")

    def command(self, method: str, **parameters: object) -> dict[str, Any]:
        return self._send(method, parameters, self._session)

    def open(self, url: str, *, script: bool = True) -> None:
        """Load a page, with or without JavaScript."""
        self.command("Emulation.setScriptExecutionDisabled", value=not script)
        self.command("Page.navigate", url=url)
        self.wait_for("document.readyState === 'complete'")

    def resize(self, width: int = 1400, height: int = 1000) -> None:
        """Set the size of the window in pixels; below 600 it is a telephone's."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 600,
        )  # fmt: skip

    def medium(self, medium: str = "screen", *, dark: bool = False) -> None:
        """Show the page on screen or printed, in light or dark colours."""
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", media=medium, features=[scheme])

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.command(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Wait until a JavaScript expression is true."""
        give_up_s = time.monotonic() + _ANSWER_S
        while not self.value(expression):
            if time.monotonic() > give_up_s:
                raise TimeoutError(f"not within {_ANSWER_S:g} s: {expression}")
            time.sleep(_POLL_S)

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

    def click(self, selector: str) -> None:
        """Click once in the middle of an element."""
        x, y = self.value(
            f"(() => {{ const e = document.querySelector({selector!r}); e.scrollIntoView();"
            " const b = e.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", clickCount=1)

    def double_click(self, x: float, y: float) -> None:
        """Click twice."""
        for count in (1, 2):
            self.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=count)
            self.mouse("mouseReleased", x, y, button="left", clickCount=count)

    def press(self, key: str) -> None:
        """Press and release a key."""
        for kind in ("keyDown", "keyUp"):
            self.command("Input.dispatchKeyEvent", type=kind, key=key)

    def screenshot(self, path: Path) -> None:
        """Save a picture of the whole page."""
        shot = self.command("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Start a browser with an empty profile; end it after the `with` body.

    Raises:
        FileNotFoundError: there is none.
    """
    program = find_browser()
    if program is None:
        raise FileNotFoundError(f"no browser: expected one of {', '.join(_NAMES)} in PATH")
    to_child, from_us = os.pipe()
    from_child, to_us = os.pipe()
    process = _started(program, profile, to_child, to_us)
    os.close(to_child)
    os.close(to_us)
    try:
        with os.fdopen(from_us, "wb", 0) as sending, os.fdopen(from_child, "rb") as receiving:
            yield _first_page(sending, receiving)
    finally:
        process.kill()
        process.wait()


def _started(program: str, profile: Path, reading: int, writing: int) -> subprocess.Popen[bytes]:
    # Above the numbers that the browser reads and writes.
    high = [
        fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, _WRITES + 1) for number in (reading, writing)
    ]

    def place() -> None:
        for number, wanted in zip(high, (_READS, _WRITES), strict=True):
            os.dup2(number, wanted)

    try:
        return _popen(program, profile, place)
    finally:
        for number in high:
            os.close(number)


def _popen(program: str, profile: Path, place: Callable[[], None]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [
            program, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--remote-debugging-pipe", "--no-first-run", f"--user-data-dir={profile}",
            "about:blank",
        ],
        # All other descriptors of this process close at exec.
        preexec_fn=place, close_fds=False,  # noqa: PLW1509 - it only duplicates
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def _first_page(sending: Any, receiving: Any) -> Page:
    number, rest = 0, b""
    errors: list[str] = []

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
            event, about = answer.get("method"), answer.get("params", {})
            if event == "Runtime.exceptionThrown":
                errors.append(json.dumps(about))
            if event == "Log.entryAdded" and about["entry"]["level"] == "error":
                errors.append(about["entry"]["text"])
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    target = send("Target.createTarget", {"url": "about:blank"})["targetId"]
    session = send("Target.attachToTarget", {"targetId": target, "flatten": True})["sessionId"]
    return Page(send, session, errors)
