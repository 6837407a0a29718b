"""Fixtures of the tests of supervision: virtual time, and a loop process that a test plays."""

from __future__ import annotations

from collections.abc import Callable

import pytest

MODULE = "levid.daemon.supervision"


class Time:
    """The clock of the supervisor: `on_sleep` is called with the number of each sleep."""

    def __init__(self) -> None:
        self.now_s, self.sleeps = 1000.0, 0
        self.on_sleep: Callable[[int], None] = lambda _: None

    def monotonic(self) -> float:
        return self.now_s

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now_s)

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.sleeps += 1
        self.on_sleep(self.sleeps)


class PlayedLoop:
    """A loop process that reads no control words, as while it opens devices."""

    def __init__(self) -> None:
        self.running, self.pid, self.end, self.waited_s = False, None, "exit code 143", 0.0
        self.done: list[str] = []
        self.error: OSError | None = None

    def start(self, *_: object) -> None:
        self.done.append("started")
        if self.error is not None:
            raise self.error
        self.running = True

    def terminate(self) -> None:
        self.done.append("terminated")
        self.running = False

    def wait(self, _: float) -> bool:
        self.done.append("waited")
        return not self.running

    def kill(self, *_: float) -> None:
        if self.running:
            self.done.append("killed")
        self.running = False


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    """Virtual time of the supervisor and of what it watches in its own thread."""
    time = Time()
    for module in ("supervisor", "loop_monitor", "fault_clearing"):
        monkeypatch.setattr(f"{MODULE}.{module}.time", time)
    return time


@pytest.fixture
def loop() -> PlayedLoop:
    return PlayedLoop()
