"""Test the supervisor in rare situations, in virtual time and without its other processes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml
from daemon_process import calm
from waiting import wait_until

from levid.config.daemon_settings import Service
from levid.config.rig import load_rig
from levid.config.shipped import shipped
from levid.daemon.api.control_server import Server, ServerError
from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.host.peer_credentials import Access
from levid.daemon.ipc.shared_memory import SharedMemory
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.supervision import supervisor as supervisor_module
from levid.daemon.supervision.supervisor import Supervisor

RIG_FILE = shipped("rigs/loopback.yaml")


class Reply:
    """A reply that keeps its answers."""

    def __init__(self) -> None:
        self.answers: list[Any] = []
        self.waiting = True

    def done(self, **answer: Any) -> None:
        self.answers.append(answer)

    def refuse(self, error: str) -> None:
        self.answers.append(error)


class KeptMemory(SharedMemory):
    """Shared memory that a test reads after the supervisor's end."""

    def close(self) -> None:
        return


class Bench:
    """A supervisor whose loop is played, and whose recorder and planner do nothing."""

    def __init__(self, folder: Path, loop: Any, time: Any, patch: pytest.MonkeyPatch) -> None:
        self.loop, self.time, self.logged = loop, time, list[str]()
        rig = calm(load_rig(RIG_FILE), folder, sim=str(shipped("sims/nominal.yaml")))
        self.shared = KeptMemory(rig)
        self.control_words = self.shared.control_words
        patch.setattr(supervisor_module, "SharedMemory", lambda _: self.shared)
        patch.setattr(supervisor_module, "Child", lambda *_: loop)
        for name in ("RecorderLink", "PlannerLink"):
            patch.setattr(supervisor_module, name, MagicMock())
        self.rig_file = folder / "rig.yaml"
        self.rig_file.write_text(yaml.safe_dump(rig.model_dump(mode="json")))
        self.supervisor = Supervisor(rig, self.rig_file, folder / "socket", self.logged.append)

    def run(self, *script: Callable[[], object]) -> None:
        """Run the supervisor, with a step of the script after each tick; then stop it."""

        def step(n: int) -> None:
            if n <= len(script):
                script[n - 1]()
            else:
                self.supervisor.stop()

        self.time.on_sleep = step
        self.supervisor.run()

    def opened(self) -> None:
        """Let the loop have opened its devices."""
        self.control_words[Word.BUSY], self.control_words[Word.STATE] = 0, State.IDLE


@pytest.fixture
def bench(tmp_path: Path, loop, time, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench(tmp_path, loop, time, monkeypatch)
    yield bench
    SharedMemory.close(bench.shared)


def test_lost_rows_are_logged(bench: Bench) -> None:
    def lose() -> None:
        ring = bench.shared.ring
        ring.head = ring.capacity + 41  # 42 rows more than there is room for
        bench.time.now_s += 2.0

    bench.run(lose)
    assert any("lost 42 rows" in line for line in bench.logged)


def test_failed_loop_start_is_reported_and_can_be_retried(bench: Bench) -> None:
    control_words, replies = bench.control_words, [Reply(), Reply()]

    def die() -> None:
        bench.loop.running = False
        bench.loop.error = BlockingIOError(11, "Resource temporarily unavailable")

    def clear(reply: Any) -> Callable[[], None]:
        return lambda: bench.supervisor.post(lambda: bench.supervisor.clear(reply, 0))

    def failed() -> None:
        assert (control_words.state, control_words.fault, control_words[Word.BUSY]) == (
            State.FAULT,
            Fault.LOOP,
            0,
        )

    bench.run(die, clear(replies[0]), failed, clear(replies[1]), failed)
    assert bench.loop.done == ["started"] * 3
    recorder: Any = bench.supervisor.recorder
    recorder.fault.assert_called_once_with(Fault.LOOP)  # when the loop died
    for reply in replies:
        (answer,) = reply.answers
        assert "cannot start" in answer
        assert "Resource temporarily unavailable" in answer


@pytest.mark.parametrize("state", [State.OFF, State.SELF_TEST])
def test_clear_that_is_not_tried_in_time_is_refused(bench: Bench, state: State) -> None:
    control_words, reply = bench.control_words, Reply()

    def clear() -> None:
        control_words[Word.STATE], control_words[Word.FAULT] = State.FAULT, Fault.STOPPED
        bench.supervisor.clear(reply, 0)  # type: ignore[arg-type]
        control_words[Word.STATE], control_words[Word.FAULT] = state, Fault.NONE

    def unanswered() -> None:
        assert reply.answers == []
        bench.time.now_s += 121.0  # devices may take 120 s

    bench.run(clear, unanswered)
    assert len(reply.answers) == 1
    assert "still being opened or tested" in reply.answers[0]


def test_watchdog_is_fed_while_the_last_client_is_answered(
    tmp_path: Path, loop, time, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []

    class JobRunner:
        job: object | None = object()

        def tick(self) -> None:
            done.append("tick")
            if done.count("tick") == 4:
                self.job = None

    notify = MagicMock()
    notify.alive = lambda: done.append("alive")
    monkeypatch.setattr(supervisor_module, "Notify", lambda: notify)
    bench = Bench(tmp_path, loop, time, monkeypatch)
    monkeypatch.setattr(bench.supervisor, "job_runner", JobRunner())
    bench.supervisor.stop()
    bench.supervisor.run()
    assert bench.loop.done == ["started", "terminated"]
    assert done == ["tick", *["alive", "tick"] * 3]  # three times without a loop
    SharedMemory.close(bench.shared)


def test_daemon_without_control_socket_lands_and_ends_in_an_error(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def land() -> None:
        assert bench.control_words[Word.END]
        bench.control_words[Word.STATE] = State.OFF
        bench.loop.running = False

    def fly() -> None:
        bench.opened()
        bench.control_words[Word.STATE] = State.LEVITATING
        monkeypatch.setattr(Server, "dead", property(lambda _: True))

    with pytest.raises(ServerError, match="control socket failed"):
        bench.run(fly, lambda: None, land)
    assert bench.logged == [
        "the control socket failed: landing, then ending the daemon",
        "landing",
    ]


@pytest.mark.parametrize("at_once", [False, True])
def test_end_while_devices_are_opened_lets_the_loop_close_them(bench: Bench, at_once: bool) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    if at_once:
        with pytest.raises(KeyboardInterrupt):
            bench.run(interrupt)
    else:
        bench.run()
    assert bench.loop.done == ["started", "terminated", *["waited"] * at_once]
    assert bench.control_words.fault is not Fault.LOOP  # its end was requested


def test_slow_look_up_of_users_does_not_block_the_supervisor(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, looking, supervisor = threading.Event(), [], bench.supervisor
    plain = supervisor.rig.model_dump(mode="json")
    plain["service"] |= {"allow_users": ["far"], "client_gone": "land"}
    bench.rig_file.write_text(yaml.safe_dump(plain))

    def far_away(config: Service) -> Access:
        looking.append(config)
        assert go_on.wait(20.0)
        return Access(Service())

    monkeypatch.setattr("levid.daemon.supervision.rig_reload.Access", far_away)

    def blocked() -> None:
        wait_until(lambda: looking)

    def still_blocked() -> None:
        assert supervisor.rig.service.client_gone == "go_on"
        assert len(looking) == 1
        assert not bench.logged
        go_on.set()
        wait_until(lambda: len(looking) == 2)  # the requests of meanwhile are one more

    def until_reloaded(n: int) -> None:
        if sum("reloaded" in line for line in bench.logged) == 2:
            supervisor.stop()
        assert n < 10_000

    # One look-up at a time; requests of meanwhile are answered by one more.
    steps = [supervisor.reload, blocked, *[supervisor.reload] * 3, still_blocked]

    def step(n: int) -> None:
        threading.Event().wait(0.001)  # let the reader's thread run
        steps[n - 1]() if n <= len(steps) else until_reloaded(n)

    bench.time.on_sleep = step
    supervisor.run()
    assert supervisor.rig.service.client_gone == "land"
    assert len(looking) == 2


def test_missing_readings_are_logged(bench: Bench) -> None:
    def miss() -> None:
        bench.time.now_s += 2.0
        bench.control_words[Word.CYCLE] += 2000
        bench.control_words[Word.STALE] += 2000

    bench.run(bench.opened, miss, miss, miss)
    assert any("readings have been missing for 4 s" in line for line in bench.logged)
