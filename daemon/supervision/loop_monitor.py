"""Start and end the loop process; detect that it died, hangs, or ignores a stop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from ..control.faults import Fault
from ..control.states import State
from ..host.child_process import Child
from ..host.clock_excluding_suspension import ProcessClock
from ..ipc.shared_status_words import ControlWords, Word
from .fault_clearing import OPENING_S

_STOP_S = 0.25
"""Time limit for the loop to react to a stop; it needs one cycle."""
_STOPPING_S = 2.0
_KILL_S = 0.5
"""Time limit to wait for the end of a killed loop."""


class LoopMonitor:
    """Keep watch on the loop process `child` through the control words.

    Args:
        hung_s: time without progress after which the loop is killed.
        alive: called while the loop advances.
        lost: called with the fault's reason if the loop was lost; its devices expire to zero force.
    """

    def __init__(
        self,
        child: Child,
        control_words: ControlWords,
        hung_s: float,
        alive: Callable[[], None],
        lost: Callable[[str], None],
    ) -> None:
        self._child, self._control_words, self._hung_s = child, control_words, hung_s
        self._alive, self._lost = alive, lost
        self._clock = ProcessClock()
        self._beat, self._beat_s, self._busy_s = -1, 0.0, 0.0
        self._stop_s: float | None = None

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._child.running

    @property
    def pid(self) -> int | None:
        """Process id, None if the process has ended."""
        return self._child.pid

    def start(self, arguments: Sequence[object], fds: Sequence[int]) -> None:
        """Start the process; it opens the devices first. Raises OSError."""
        control_words = self._control_words
        control_words[Word.STATE] = State.OFF
        control_words[Word.BUSY] = 1
        self._busy_s = self._clock.update(time.monotonic())
        self._child.start(arguments, fds)

    def forget_stop(self) -> None:
        """Restart the time limit for the reaction to a stop."""
        self._stop_s = None

    def watch(self, ending: bool) -> None:
        """Detect a loop that died, hangs, or ignores a stop; `ending`: its end is requested."""
        # The time that the whole machine was suspended does not count.
        control_words, now_s = self._control_words, self._clock.update(time.monotonic())
        if not self.running:
            if control_words.fault is not Fault.LOOP and not (
                ending and control_words.state is State.OFF
            ):
                stopped = control_words[Word.BUSY] and control_words[Word.ZERO]
                reason = "stopped while its devices were being opened; " if stopped else ""
                self._report(f"{reason}{self._child.end}")
            return
        if control_words.fault is Fault.LOOP:  # killed, but not ended yet
            self._child.kill(0.0)
            return
        beat = control_words[Word.CYCLE] + control_words[Word.WAITING]
        if beat != self._beat or control_words[Word.BUSY]:
            self._beat, self._beat_s = beat, now_s
            self._alive()
        if control_words[Word.BUSY]:
            if control_words[Word.ZERO]:
                self.interrupt_opening()
            if now_s - self._busy_s > OPENING_S:
                self._end(f"its devices did not open within {OPENING_S:g} s")
            return
        self._busy_s = now_s
        if now_s - self._beat_s > self._hung_s:
            self._end(f"it did not advance for {now_s - self._beat_s:.1f} s")
        elif control_words[Word.ZERO] and control_words.fault is Fault.NONE:
            self._stop_s = now_s if self._stop_s is None else self._stop_s
            if now_s - self._stop_s > _STOP_S:
                self._end("it did not react to a stop")
        else:
            self._stop_s = None

    def interrupt_opening(self) -> None:
        """End a loop that opens devices: it may be homing and not read the control words."""
        if self._control_words[Word.BUSY]:
            self._child.terminate()

    def kill(self) -> None:
        """Kill the process."""
        self._child.kill()

    def end_at_once(self) -> None:
        """Command zero force and end the loop if it still runs."""
        if self.running:
            self._control_words.stop(Fault.SUPERVISOR, "the supervisor is ending")
            self._control_words[Word.END] = 1
            self.interrupt_opening()
            self._child.wait(_STOPPING_S)
        self.kill()

    def _end(self, reason: str) -> None:
        self._child.kill(_KILL_S)
        self._report(f"{reason}; {self._child.end}")

    def _report(self, reason: str) -> None:
        """Set the fault LOOP."""
        control_words = self._control_words
        control_words.detail = reason
        control_words[Word.FAULT_CYCLE], control_words[Word.FAULT_PLAN] = (
            control_words[Word.CYCLE],
            control_words[Word.PLAN],
        )
        control_words[Word.BUSY] = 0
        control_words[Word.STATE], control_words[Word.FAULT] = State.FAULT, Fault.LOOP
        self._lost(reason)
