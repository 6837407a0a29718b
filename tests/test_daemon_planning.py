"""Whoever waits for a long session to be planned hears that it is, and does not give up."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

from levid.daemon.board import Word
from levid.daemon.faults import Fault
from levid.daemon.requests import Requests
from levid.daemon.states import State


class Board(dict[Word, int]):
    fault, state = Fault.NONE, State.IDLE


def test_planning_that_takes_long_is_told_now_and_then() -> None:
    began, go_on, refused = threading.Event(), threading.Event(), threading.Event()
    sent: list[dict[str, Any]] = []
    reply: Any = SimpleNamespace(send=sent.append, refuse=lambda _: refused.set())
    board = Board({Word.LAND: 0, Word.CLEAR: 0, Word.LOOPS: 1})
    requests = Requests(SimpleNamespace(board=board))  # type: ignore[arg-type]

    def planner(*_: object) -> Any:
        began.set()
        go_on.wait(60.0)
        raise ValueError("enough")

    requests.start()
    requests._plan(planner, {}, reply)
    assert began.wait(60.0)
    begin_s = requests._told_s
    for passed_s in (1.0, 6.0, 7.0, 12.0):
        requests.tick(begin_s + passed_s, dict)
    assert sent == [{"step": "planning", "share": 0.0}] * 2
    go_on.set()
    assert refused.wait(60.0)
    requests.tick(begin_s + 100.0, dict)
    assert len(sent) == 2
