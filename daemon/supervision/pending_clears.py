"""Those who wait for a fault to be cleared: it may take minutes, for drives are homed."""

from __future__ import annotations

import time
from dataclasses import dataclass

from ..api.control_server import Reply
from ..control.faults import Fault
from ..control.states import State
from ..ipc.control_words import Board, Word

OPENING_S = 120.0
"""How long devices may take to open, compare limits and home."""


@dataclass
class _Clearing:
    reply: Reply
    fault: Fault
    number: int
    give_up_s: float


class Clearings:
    """Answers whoever asked once the loop has tried, or has taken too long."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._waiting: list[_Clearing] = []

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._waiting)

    def add(self, reply: Reply, fault: Fault) -> None:
        """Answer whoever asked for `fault` to be cleared by the last request on the board."""
        give_up_s = time.monotonic() + OPENING_S
        self._waiting.append(_Clearing(reply, fault, self._board[Word.CLEAR], give_up_s))

    def answer(self) -> None:
        """Answer those that can be answered."""
        board = self._board
        for clearing in list(self._waiting):
            testing = board.state in (State.OFF, State.SELF_TEST)
            trying = board[Word.CLEARED] < clearing.number or testing
            in_time = time.monotonic() < clearing.give_up_s
            if trying and in_time and board.fault is not Fault.LOOP:
                continue
            self._waiting.remove(clearing)
            if board.fault is not Fault.NONE:
                clearing.reply.refuse(f"the fault {board.fault.name} stays: {board.detail}")
            elif trying:
                clearing.reply.refuse(
                    f"after {OPENING_S:g} s devices are still being opened or tested: "
                    "'levid status' says when it is done"
                )
            else:
                clearing.reply.done(cleared=clearing.fault.name)
