"""What the loop's process does around its cycles: opening devices, and being ended meanwhile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon import loop_process
from levid.daemon.board import Board, Word
from levid.daemon.faults import Fault
from levid.daemon.states import State
from levid.drivers.base import LinkError

RIG_FILE = shipped("rigs/loopback.yaml")


def test_devices_that_open_at_the_second_try_are_not_ready_before_their_self_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    board, devices = Board(memoryview(bytearray(Board.SIZE))), object()
    answers: list[Any] = [LinkError("no cable"), devices]

    def open_devices(_: object) -> Any:
        answer = answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def wait(_: float) -> None:
        assert (board.fault, board.state) == (Fault.LINK, State.FAULT)
        board[Word.CLEAR] += 1

    monkeypatch.setattr(loop_process, "open_devices", open_devices)
    monkeypatch.setattr(loop_process.time, "sleep", wait)
    opened = loop_process._opened(load_rig(RIG_FILE), Path(), board, lambda _: None)
    assert opened is devices
    # The supervisor answers a clear once the loop is neither OFF nor in its self-test.
    assert (board.fault, board.state) == (Fault.NONE, State.OFF)
    assert board[Word.CLEARED] == board[Word.CLEAR]
