"""Answer requests to clear a fault, which may take minutes because drives are homed."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ..api.control_server import Reply
from ..control.faults import Fault
from ..control.states import State
from ..ipc.shared_status_words import ControlWords, Word

OPENING_S = 120.0
"""Time limit for opening devices, comparing limits and homing."""


@dataclass
class _Clearing:
    reply: Reply
    fault: Fault
    number: int
    deadline_s: float


class PendingClears:
    """Answer requests to clear once the loop has tried, or at a time limit."""

    def __init__(self, control_words: ControlWords) -> None:
        self._control_words = control_words
        self._waiting: list[_Clearing] = []

    def __len__(self) -> int:
        """Return the number of waiting requests."""
        return len(self._waiting)

    def add(self, reply: Reply, fault: Fault) -> None:
        """Register `reply` for the last request in the control words, which is to clear `fault`."""
        deadline_s = time.monotonic() + OPENING_S
        self._waiting.append(_Clearing(reply, fault, self._control_words[Word.CLEAR], deadline_s))

    def answer(self) -> None:
        """Answer the requests whose result is known."""
        control_words = self._control_words
        for clearing in list(self._waiting):
            testing = control_words.state in (State.OFF, State.SELF_TEST)
            trying = control_words[Word.CLEARED] < clearing.number or testing
            in_time = time.monotonic() < clearing.deadline_s
            if trying and in_time and control_words.fault is not Fault.LOOP:
                continue
            self._waiting.remove(clearing)
            if control_words.fault is not Fault.NONE:
                clearing.reply.refuse(
                    f"fault {control_words.fault.name} is not cleared: {control_words.detail}"
                )
            elif trying:
                clearing.reply.refuse(
                    f"devices are still being opened or tested after {OPENING_S:g} s: "
                    "see 'levid status'"
                )
            else:
                clearing.reply.done(cleared=clearing.fault.name)
