"""What the supervisor does in moments that processes seldom come to: it alone, without any."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_process import calm

from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon import supervisor as supervisor_module
from levid.daemon.board import Word
from levid.daemon.faults import Fault
from levid.daemon.states import State
from levid.daemon.supervisor import Supervisor

RIG_FILE = shipped("rigs/loopback.yaml")


class Told:
    """A reply that keeps what it was told."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.waiting = True

    def done(self, **answer: Any) -> None:
        self.answers.append(answer)

    def refuse(self, error: str) -> None:
        self.answers.append(error)


@pytest.fixture
def supervisor(tmp_path: Path) -> Iterator[Supervisor]:
    made = Supervisor(
        calm(load_rig(RIG_FILE), tmp_path), RIG_FILE, tmp_path / "levid.sock", lambda _: None
    )
    yield made
    made._shared.close()


def test_loop_that_cannot_be_started_is_told_and_can_be_tried_again(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    board, tries = supervisor.board, 0

    def start(*_: object) -> None:
        nonlocal tries
        tries += 1
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(supervisor._loop, "start", start)
    board[Word.STATE], board[Word.FAULT] = State.FAULT, Fault.LOOP
    for n in (1, 2):
        reply: Any = Told()
        supervisor.post(lambda reply=reply: supervisor.clear(reply))
        supervisor._mail.popleft()()
        assert tries == n
        assert "cannot be started" in reply.answers[0]
        assert "Resource temporarily unavailable" in reply.answers[0]
        assert (board.state, board.fault, board[Word.BUSY]) == (State.FAULT, Fault.LOOP, 0)
    assert not supervisor._clearings


@pytest.mark.parametrize("state", [State.OFF, State.SELF_TEST])
def test_clear_whose_time_is_over_before_the_self_test_is_not_done(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch, state: State
) -> None:
    board, reply = supervisor.board, Told()
    now_s = 1000.0
    monkeypatch.setattr(supervisor_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(supervisor._loop, "start", lambda *_: None)
    board[Word.STATE], board[Word.FAULT] = State.FAULT, Fault.LOOP
    supervisor.clear(reply)  # type: ignore[arg-type]
    board[Word.STATE] = state
    supervisor._answer_clearings()
    assert reply.answers == []
    now_s += 121.0  # devices may take 120 s
    supervisor._answer_clearings()
    assert len(reply.answers) == 1
    assert "still being opened or tested" in reply.answers[0]


def test_watchdog_is_fed_while_the_end_is_being_told(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    class Pilot:
        job: object | None = object()

        def tick(self) -> None:
            done.append("tick")
            if len(done) >= 6:
                self.job = None

    monkeypatch.setattr(supervisor, "pilot", Pilot())
    monkeypatch.setattr(supervisor._recorder, "watch", lambda: None)
    monkeypatch.setattr(supervisor._notify, "alive", lambda: done.append("alive"))
    supervisor._land_and_end()  # there is no loop: what is left is to tell how it ended
    assert done == ["alive", "tick"] * 3
