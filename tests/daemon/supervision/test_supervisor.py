"""Test the supervisor in rare situations, without its other processes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from daemon_process import calm

from levid.config.rig import load_rig
from levid.config.service import Service
from levid.config.shipped import shipped
from levid.daemon.api.control_server import ServerError
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.host.access_control import Access
from levid.daemon.ipc.control_words import Word
from levid.daemon.supervision import supervisor as supervisor_module
from levid.daemon.supervision.supervisor import Supervisor

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


def test_stop_while_devices_are_being_opened_ends_their_loop(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be homing drives: a stop that waits for the end of that is none."""
    board, asked = supervisor.board, []

    class Opening:
        running, end = True, "exit code 143"

        def terminate(self) -> None:
            asked.append(True)

    loop = Opening()
    monkeypatch.setattr(supervisor, "_loop", loop)
    board[Word.BUSY] = 1
    supervisor._busy_s = time.monotonic()
    supervisor._watch_loop()
    assert not asked
    board.stop()
    supervisor._watch_loop()
    assert asked
    loop.running = False
    supervisor._watch_loop()
    assert board.fault is Fault.LOOP
    assert "stopped while its devices were being opened; exit code 143" in board.detail


def test_suspended_machine_has_not_lost_its_loop(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, ended = 1000.0, []
    monkeypatch.setattr(supervisor_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(supervisor, "_loop", SimpleNamespace(running=True))
    monkeypatch.setattr(supervisor, "_end_loop", ended.append)
    supervisor._watch_loop()
    for _ in range(100):  # it was paused for a minute each time: what hangs is given 30 s
        now_s += 60.0
        supervisor._watch_loop()
    assert not ended
    for _ in range(4000):
        now_s += 0.01
        supervisor._watch_loop()
    assert "it did not advance for 30.0 s" in ended[0]


def test_lost_rows_are_logged(supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, said = 1000.0, []
    monkeypatch.setattr(supervisor_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(supervisor._resources, "_log", said.append)
    monkeypatch.setattr(supervisor, "_watch_loop", lambda: None)
    monkeypatch.setattr(supervisor.recorder, "watch", lambda: None)
    supervisor._tick()
    ring = supervisor._shared.ring
    ring.head = ring.capacity + 41  # 42 rows more than nobody's having looked leaves room for
    now_s += 2.0
    supervisor._tick()
    assert any("lost 42 rows" in line for line in said)


def test_failed_loop_start_is_reported_and_can_be_retried(
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
        supervisor.post(lambda reply=reply: supervisor.clear(reply, 0))
        supervisor._actions.popleft()()
        assert tries == n
        assert "cannot start" in reply.answers[0]
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
    supervisor.clear(reply, 0)  # type: ignore[arg-type]
    board[Word.STATE] = state
    supervisor._clearings.answer()
    assert reply.answers == []
    now_s += 121.0  # devices may take 120 s
    supervisor._clearings.answer()
    assert len(reply.answers) == 1
    assert "still being opened or tested" in reply.answers[0]


def test_watchdog_is_fed_while_the_last_client_is_answered(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    class JobRunner:
        job: object | None = object()

        def tick(self) -> None:
            done.append("tick")
            if len(done) >= 6:
                self.job = None

    monkeypatch.setattr(supervisor, "job_runner", JobRunner())
    monkeypatch.setattr(supervisor.recorder, "watch", lambda: None)
    monkeypatch.setattr(supervisor._notify, "alive", lambda: done.append("alive"))
    supervisor._land_and_end()  # there is no loop: what is left is to tell how it ended
    assert done == ["alive", "tick"] * 3


def test_daemon_without_control_socket_lands_and_ends_in_an_error(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    monkeypatch.setattr(supervisor, "_log", done.append)
    monkeypatch.setattr(supervisor, "_start_loop", lambda: None)
    monkeypatch.setattr(supervisor, "_watch_loop", lambda: None)
    monkeypatch.setattr(supervisor, "_land_and_end", lambda: done.append("landed"))
    for name in ("watch", "end"):
        monkeypatch.setattr(supervisor.recorder, name, lambda *_: None)
    monkeypatch.setattr(supervisor._shared, "close", lambda: None)  # the fixture does
    monkeypatch.setattr(supervisor._server._selector, "select", lambda *_: 1 / 0)
    with pytest.raises(ServerError, match="control socket failed"):
        supervisor.run()
    assert done == ["the control socket failed: landing, then ending the daemon", "landed"]


class Opening:
    """A loop that does not look at the board, since it opens devices."""

    def __init__(self) -> None:
        self.running, self.end, self.done = True, "exit code 143", list[str]()

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


@pytest.mark.parametrize("hurry", [False, True])
def test_end_while_devices_are_opened_lets_the_loop_close_them(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch, hurry: bool
) -> None:
    loop, board = Opening(), supervisor.board
    monkeypatch.setattr(supervisor, "_loop", loop)
    monkeypatch.setattr(supervisor.recorder, "watch", lambda: None)
    board[Word.BUSY] = 1
    supervisor.stop()
    if not hurry:
        supervisor._land_and_end()
    supervisor._end_loop_at_once()
    assert loop.done == (["terminated", "waited"] if hurry else ["terminated"])
    assert board.fault is not Fault.LOOP  # it was asked to


def test_slow_look_up_of_users_does_not_block_the_supervisor(
    supervisor: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, looking, said = threading.Event(), [], []
    plain = supervisor.rig.model_dump(mode="json")
    plain["service"] |= {"allow_users": ["far"], "client_gone": "land"}
    file = tmp_path / "rig.yaml"
    file.write_text(yaml.safe_dump(plain))

    def far_away(config: Service) -> Access:
        looking.append(config)
        assert go_on.wait(20.0)
        return Access(Service())

    monkeypatch.setattr("levid.daemon.supervision.rig_reload.Access", far_away)
    monkeypatch.setattr(supervisor._reader, "_rig_file", file)
    monkeypatch.setattr(supervisor, "_log", said.append)
    monkeypatch.setattr(supervisor, "_watch_loop", lambda: None)
    monkeypatch.setattr(supervisor.recorder, "watch", lambda: None)

    def tick_until(condition: Callable[[], bool]) -> None:
        give_up_s = time.monotonic() + 15.0  # reading a RIG.yaml takes milliseconds
        while not condition():
            assert time.monotonic() < give_up_s
            supervisor._tick()
            time.sleep(0.001)

    supervisor._reader.start()
    supervisor.reload()
    tick_until(lambda: len(looking) == 1)
    for _ in range(3):  # no more than one at a time
        supervisor.reload()
        supervisor._tick()
    assert supervisor.rig.service.client_gone == "go_on"
    assert len(looking) == 1
    assert not said
    go_on.set()
    # What was asked for meanwhile is one reading more.
    tick_until(lambda: sum("reloaded" in line for line in said) == 2)
    assert supervisor.rig.service.client_gone == "land"
    assert len(looking) == 2


def test_missing_readings_are_logged(
    supervisor: Supervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, said, board = 1000.0, [], supervisor.board
    monkeypatch.setattr(supervisor_module.time, "monotonic", lambda: now_s)
    monkeypatch.setattr(supervisor._stale_monitor, "_log", said.append)
    monkeypatch.setattr(supervisor, "_watch_loop", lambda: None)
    monkeypatch.setattr(supervisor.recorder, "watch", lambda: None)
    board[Word.STATE] = State.IDLE
    for _ in range(3):
        supervisor._tick()
        now_s += 2.0
        board[Word.CYCLE] += 2000
        board[Word.STALE] += 2000
    assert any("readings have been missing for 4 s" in line for line in said)
