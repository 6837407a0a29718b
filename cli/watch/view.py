"""Keep what the full screen of `levid watch` shows: status, recent values, events, messages."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ...config.escaping import one_line
from ...daemon.control.states import IN_FLIGHT
from ..readable_values import Scale, scale_of

_HISTORY = 600
_INTERVAL_S = 0.5
"""Shortest interval of the charts: they change, and are sent to the terminal, twice a second."""
_OBSERVED = 60

Status = Mapping[str, Any]
Range = tuple[float, float]
"""Smallest and largest value of an interval."""


@dataclass
class View:
    """Hold the newest status and what the screen adds to it.

    problem: why no status arrives; empty if connected. message: outcome of the last key, with its
    style. asking: the request that waits for a confirmation. free_bytes: free space of the disk of
    the logs, None if unknown. heard_s, cycled_s: time of the newest status, and of the newest one
    with a new cycle. history: ranges of each DOF of the pose. begun_s: when their intervals began.
    """

    status: Status | None = None
    problem: str = ""
    message: tuple[str, str] = ("", "")
    asking: str = ""
    help: bool = False
    free_bytes: int | None = None
    heard_s: float = 0.0
    cycled_s: float = 0.0
    history: dict[str, deque[Range | None]] = field(default_factory=dict)
    begun_s: deque[float] = field(default_factory=lambda: deque(maxlen=_HISTORY))
    charts: dict[tuple[str, int, int], tuple[float, list[str]]] = field(default_factory=dict)
    """Charts by DOF, width and height, with the time of their newest interval."""
    _ranges: dict[str, Range | None] = field(default_factory=dict)
    _begun_s: float | None = None
    _observed: deque[tuple[float, str]] = field(default_factory=lambda: deque(maxlen=_OBSERVED))
    _scales: dict[str, Scale] = field(default_factory=dict)

    def receive(self, status: Status, now_s: float) -> None:
        """Take a status that came at a time of the monotonic clock."""
        status = _escaped(status)
        before = self.status
        if before is None or before["cycle"] != status["cycle"]:
            self.cycled_s = now_s
        if self.problem:
            self._observe("connected to the daemon again" if before else "connected to the daemon")
        elif before is not None:
            for text in _changes(before, status):
                self._observe(text)
        self.status, self.problem, self.heard_s = status, "", now_s
        self._extend_history(status, now_s)

    def lose(self, problem: str) -> None:
        """Take the reason why no status arrives."""
        if not self.problem and self.status is not None:
            self._observe("lost the connection to the daemon")
        self.problem = one_line(problem)

    @property
    def silent_s(self) -> float:
        """Time since the newest status in s."""
        return time.monotonic() - self.heard_s

    @property
    def without_cycle_s(self) -> float:
        """Time since the newest cycle in s: how old the readings are."""
        return time.monotonic() - self.cycled_s

    def scale(self, name: str, unit: str, noise: float | None, limit: float | None) -> Scale:
        """Return the scale of a quantity; its number of decimals does not flicker."""
        scale = scale_of(unit, noise, limit, self._scales.get(name))
        self._scales[name] = scale
        return scale

    def events(self) -> list[tuple[float, str]]:
        """Return (seconds since 1970, text) of journal lines and observed changes, oldest first."""
        journal = [(e["time_s"], e["text"]) for e in (self.status or {}).get("events", ())]
        return sorted([*journal, *self._observed], key=lambda event: event[0])

    def _extend_history(self, status: Status, now_s: float) -> None:
        """Extend the ranges of the present interval, or end it and begin the next one."""
        if self._begun_s is not None and now_s - self._begun_s >= _INTERVAL_S:
            for name, ended in self._ranges.items():
                self.history.setdefault(name, deque(maxlen=_HISTORY)).append(ended)
            self.begun_s.append(self._begun_s)
            self._ranges, self._begun_s = {}, None
        if self._begun_s is None:
            self._begun_s = now_s
        for quantity in status["pose"]:
            low, high = quantity["low"], quantity["high"]
            before = self._ranges.get(quantity["name"])
            if before is not None and low is not None:
                low, high = min(low, before[0]), max(high, before[1])
            self._ranges[quantity["name"]] = before if low is None else (low, high)

    def _observe(self, text: str) -> None:
        self._observed.append((time.time(), text))


def _escaped(value: Any) -> Any:
    """Return JSON data in whose texts all characters print."""
    if isinstance(value, str):
        return one_line(value)
    if isinstance(value, dict):
        return {key: _escaped(inner) for key, inner in value.items()}
    return [_escaped(inner) for inner in value] if isinstance(value, list) else value


def in_flight(status: Status) -> bool:
    """Return whether the platform is in flight: limits of pose and gap do not apply at rest."""
    return status["state"] in {state.name for state in IN_FLIGHT}


def _changes(before: Status, now: Status) -> Iterator[str]:
    if before["state"] != now["state"]:
        yield f"state {now['state']} (was {before['state']})"
    if before["session"] != now["session"]:
        yield f"session {now['session']}" if now["session"] else f"end of {before['session']}"
    if now["step"] and before["step"] != now["step"]:
        yield f"step {now['step']}"
