"""Derive the events of a flight from its rows and from the daemon's status."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..control.faults import FAULTS, Fault
from ..control.states import State

_KEPT = 200
_REPEAT_S = 10.0


class Level(StrEnum):
    """How serious an event is."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


@dataclass(frozen=True)
class Event:
    """One event; `time_s` is the time of day."""

    time_s: float
    level: Level
    text: str


class FlightEvents:
    """Keep the last events; `on_event` is called with each new one."""

    def __init__(self, on_event: Callable[[Event], None]) -> None:
        self.kept: deque[Event] = deque(maxlen=_KEPT)
        self._on_event = on_event
        self._state = -1
        self._status: Mapping[str, Any] = {}
        self._late: int | None = None
        self._late_s = -math.inf

    def rows(self, states: NDArray[np.uint8], lost: int) -> None:
        """Add the changes of state in consecutive rows, and rows that were not seen."""
        if lost:
            self.add(Level.WARNING, f"the live view missed {lost} rows; the log has them")
        if self._state < 0:
            self._state = int(states[0])
        changes = states[np.flatnonzero(np.diff(states, prepend=self._state))]
        for state in changes.tolist():
            if state != State.FAULT:  # the fault itself is in the status, with its cause
                self.add(Level.INFO, f"{_name(State, state)}: {_meaning(state)}")
        self._state = int(states[-1])

    def status(self, status: Mapping[str, Any]) -> None:
        """Add what changed since the last status."""
        before, self._status = self._status, status
        if not before:
            self.add(Level.INFO, f"{status['rig']} at {status['rate_hz']:g} Hz")
            before = {"fault": Fault.NONE.name}
        if status["fault"] != before["fault"]:
            self._fault(status)
        if (step := status["step"]) and step != before.get("step"):
            self.add(Level.INFO, f"session {status['session']}: step {step}")
        self._late_cycles(status["late"])
        if status["recording"] and status["recording"] != before.get("recording"):
            self.add(Level.ERROR, f"not recording: {status['recording']}")
        if (lost := status.get("log_lost")) and lost != before.get("log_lost"):
            self.add(Level.ERROR, f"log: {lost}")
        restarts = status["recorder_restarts"]
        if restarts > before.get("recorder_restarts", restarts):
            self.add(Level.WARNING, "the recorder was restarted")

    def add(self, level: Level, text: str) -> None:
        """Add an event of now."""
        event = Event(time.time(), level, text)
        self.kept.append(event)
        self._on_event(event)

    def _late_cycles(self, late: int) -> None:
        """Add late cycles, rarely: on a busy machine there are many."""
        now_s = time.monotonic()
        if self._late is None or late < self._late:  # the loop was restarted
            self._late = late
        if late > self._late and now_s - self._late_s >= _REPEAT_S:
            more = late - self._late
            self.add(Level.WARNING, f"{more} late {'cycle' if more == 1 else 'cycles'}")
            self._late, self._late_s = late, now_s

    def _fault(self, status: Mapping[str, Any]) -> None:
        name = status["fault"]
        if name == Fault.NONE.name:
            self.add(Level.INFO, "fault cleared")
            return
        text = FAULTS[Fault[name]]
        detail = f" ({status['detail']})" if status["detail"] else ""
        self.add(
            Level.ERROR, f"fault {name}: {text.cause}{detail}; check: {text.check}; {text.cleared}"
        )


def _name(codes: type[State], code: int) -> str:
    return codes(code).name if code in set(codes) else str(code)


def _meaning(code: int) -> str:
    return State(code).meaning if code in set(State) else "a state of another version"
