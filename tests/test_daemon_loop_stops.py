"""Whatever comes together in one cycle, who is to stop stops, and who is alone does not fly."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_loop import LIFT, ScriptedLoop

from levid.daemon.board import Board, Word
from levid.daemon.faults import Fault
from levid.daemon.parent_watch import ALIVE, DYING, STOPPED, ParentWatch, condition
from levid.daemon.states import State
from levid.daemon.supervisor import Supervisor
from levid.drivers.base import Backend, Devices, FirstError, LinkError, StaleError


def failing_while(when: SimpleNamespace, error: Exception) -> Callable[[Devices], Devices]:
    """Return what makes readings raise this error for as long as `when.now` says so."""

    def failing(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            if when.now:
                raise error
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return devices

    return failing


def test_clear_does_not_take_back_a_stop_that_nobody_has_looked_at() -> None:
    flight = ScriptedLoop()
    supervisor = SimpleNamespace(
        board=flight.board, _stop_s=None, _loop=SimpleNamespace(running=True),
        _clearings=SimpleNamespace(add=lambda *_: None),
        pilot=SimpleNamespace(note_fault=lambda: None),
    )  # fmt: skip

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        if n == 1500:
            assert flight.board.state is State.LEVITATING
            flight.board.stop()
            Supervisor.clear(supervisor, SimpleNamespace(), flight.board[Word.STOPS])

    flight.run(script, 1510)
    assert flight.forces == 0.0
    assert flight.board.state is not State.LEVITATING
    assert not flight.board[Word.ZERO]  # and it is cleared: the next flight is not stopped by it


def test_stopped_supervisor_is_zero_force_in_the_cycle_that_is_told() -> None:
    flight = ScriptedLoop(supervisor_s=1.0)

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        if n == 1500:
            assert flight.board.state is State.LEVITATING
            flight.silent = True
            flight.board[Word.SUPERVISOR_STOPPED] = 1

    flight.run(script, 1500)
    assert flight.forces == 0.0
    assert flight.board.fault is Fault.SUPERVISOR


def test_process_is_stopped_whatever_its_name() -> None:
    def told(stat: bytes) -> int:
        return int(condition(np.frombuffer(stat, np.uint8)))

    assert told(b"7 (levid) T 1 7 7") == STOPPED
    assert told(b"7 (a) S (b) T 1 7 7") == STOPPED
    for state in (b"S", b"R", b"D", b"t"):
        assert told(b"7 (T) T) " + state + b" 1 7 7") == ALIVE
    assert told(b"") == ALIVE
    assert told(Path("/proc/self/stat").read_bytes()) == ALIVE


def test_process_that_has_to_die_is_told_from_one_that_goes_on() -> None:
    def told(flags: int, pending: int) -> int:
        stat = f"7 (levid) S 1 7 7 0 -1 {flags} {'9 ' * 21}{pending} 0 0 0 0"
        return int(condition(np.frombuffer(stat.encode(), np.uint8)))

    assert told(0x400140, 0) == ALIVE
    assert told(0x400144, 0) == DYING  # PF_EXITING of the kernel
    assert told(0x400140, 1 << 8) == DYING  # SIGKILL, 9, waits
    assert told(0x400140, 1 << 14) == ALIVE  # SIGTERM does, which is another matter
    # In a process that is dead and was not asked yet how it ended the flag still stands.
    with subprocess.Popen(["sleep", "600"]) as process:
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        stat = Path(f"/proc/{process.pid}/stat").read_bytes()
    assert condition(np.frombuffer(stat, np.uint8)) == DYING


@pytest.mark.parametrize("state", [State.IDLE, State.EXCITING])
def test_process_that_is_stopped_is_told_on_the_board_until_it_goes_on_or_is_dead(
    state: State,
) -> None:
    board = Board(memoryview(bytearray(Board.SIZE)))
    board[Word.STATE] = state

    def wait_for(stopped: int) -> None:
        give_up_s = time.monotonic() + 60.0
        while board[Word.SUPERVISOR_STOPPED] != stopped:
            assert time.monotonic() < give_up_s
            time.sleep(0.001)

    with subprocess.Popen(["sleep", "600"]) as process:
        watch = ParentWatch(process.pid, board.words, 1e-3, priority=0)
        try:
            for _ in range(2):
                process.send_signal(signal.SIGSTOP)
                wait_for(STOPPED)
                process.send_signal(signal.SIGCONT)
                wait_for(ALIVE)
            process.send_signal(signal.SIGSTOP)
            wait_for(STOPPED)
            process.kill()
            wait_for(DYING)  # until somebody asks how it ended
            process.wait()
            wait_for(ALIVE)
        finally:
            process.kill()
            watch.close()
    assert not watch._thread.is_alive()
    ParentWatch(
        process.pid, board.words, 1e-3, priority=0
    ).close()  # who is dead is watched by none
    assert not board[Word.SUPERVISOR_STOPPED]


@pytest.mark.parametrize("silence", ["in flight, and a stop as it lands", "as it lands"])
def test_orphan_lands_whatever_happened_to_its_supervisor_before(
    silence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = ScriptedLoop(supervisor_gone="land", supervisor_s=0.2)
    board, landing, seen = flight.board, [], []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"land": {}})
        if board.state is State.LANDING:
            landing.append(n)
        if silence == "as it lands":
            flight.silent = bool(landing) and landing[0] + 10 <= n < landing[0] + 300
        else:
            flight.silent = 1000 <= n < 1250
            if n == 1260:
                board.stop()
        if n == 5000:
            seen.append(board.fault)
            board.clear()
        if n == 6000:
            flight.fly({"levitate": LIFT})
        if n == 8000:
            seen.append(board.state)
            monkeypatch.setattr(os, "getppid", lambda: 1)
        if n >= 8000:
            flight.silent = True

    flight.run(script, 10_000)
    assert seen == [
        Fault.SUPERVISOR if silence == "as it lands" else Fault.STOPPED,
        State.LEVITATING,
    ]
    assert flight.forces == 0.0
    assert board.state in (State.FAULT, State.OFF)


@pytest.mark.parametrize("land", [{"ramp_s": 8.0}, {"ramp_s": 2.0, "release_s": 7.0}])
def test_orphan_goes_on_with_a_landing_that_it_has_no_more_rows_of(
    land: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are announced a few seconds ahead; then the loop goes on from the last of them."""
    flight = ScriptedLoop(supervisor_gone="land", supervisor_s=0.2)
    board, forces, landing = flight.board, [], []
    ramp, release = round(1e3 * land["ramp_s"]), round(1e3 * land.get("release_s", 0.5))

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"land": land})
            board[Word.LAND_RAMP], board[Word.LAND_RELEASE] = ramp, release
        if board.state is State.LANDING:
            landing.append(n)
            forces.append(flight.forces)
        if landing and not flight.silent:
            flight.silent = True
            monkeypatch.setattr(os, "getppid", lambda: 1)

    flight.run(script, 14_000)
    # A landing that began again, or ended early, would have other cycles.
    assert abs(len(landing) - (ramp + release)) <= 2
    # What the coils carry changes from one cycle to the next by noise of the readings alone.
    assert np.abs(np.diff(forces)).max() < 0.1 * forces[0]
    assert board.fault is Fault.SUPERVISOR


def test_who_asks_to_land_before_the_first_row_stays_on_the_ground() -> None:
    flight = ScriptedLoop()
    board, states = flight.board, set()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
            assert flight._feeder is not None
            flight._feeder.feed()
            board.land()
        states.add(board.state)
        if n == 2000:
            assert board[Word.PLAN_DONE] == flight.plans
            flight.fly({"levitate": LIFT})  # the next one flies

    flight.run(script, 1990)
    assert State.LEVITATING not in states
    flight.run(script, 2500)
    assert State.LEVITATING in states


def test_stop_in_the_cycle_that_readings_fail_in_is_written() -> None:
    stale = SimpleNamespace(now=False)
    flight = ScriptedLoop(failing_while(stale, StaleError("no clean reading")))

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
        if n == 1500:
            assert flight.forces > 10.0
            stale.now = True
            flight.board.stop()

    flight.run(script, 1502)
    assert flight.forces == 0.0


def test_bus_that_is_gone_for_days_costs_no_memory() -> None:
    """Nobody collects in the loop's process: what every cycle raises must not hold itself."""
    dead = SimpleNamespace(now=False)

    class Broken:
        def __init__(self, backend: Backend) -> None:
            self._backend = backend

        def sync(self, cycle: int, late_s: float = 0.0) -> None:
            first = FirstError()
            with first:
                self._backend.sync(cycle, late_s)
            with first:
                if dead.now:
                    raise LinkError("gone")
            first.raise_it()

        def __getattr__(self, name: str) -> object:
            return getattr(self._backend, name)

    flight = ScriptedLoop(lambda devices: replace(devices, backends=(Broken(devices.backends[0]),)))
    counts = []

    def script(n: int) -> None:
        dead.now = n >= 600
        if n in (1000, 3000):
            counts.append(gc.get_count()[0])

    gc.collect()
    gc.disable()
    try:
        flight.run(script, 3001)
    finally:
        gc.enable()
    assert flight.board.fault is Fault.LINK
    # Objects alive that were made since the collector last looked.
    assert counts[1] - counts[0] < 100


def test_a_machine_that_stood_still_did_not_lose_its_supervisor() -> None:
    flight = ScriptedLoop(supervisor_s=1.0)
    clock = flight.loop._clock

    def script(n: int) -> None:
        clock.skipped = 1500 if n == 1500 else 0
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 5.0}})
        if n == 1500:
            assert flight.board.state is State.LEVITATING

    flight.run(script, 1600)
    assert flight.board.fault is not Fault.SUPERVISOR


def test_heat_of_the_coils_outlasts_the_loop() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})

    flight.run(script, 2000)
    hot = flight.controller._heat.copy()
    assert hot.min() > 0.0
    again = type(flight.controller)(flight.rig, 1e-3, flight.shared.control)
    assert again._heat == pytest.approx(hot)
    assert not again.pose.any()


def test_coils_cool_down_while_readings_fail() -> None:
    """A link that was gone for hours left them as hot: the next lift-off ended as fault HEAT."""
    gone = SimpleNamespace(now=False)
    flight = ScriptedLoop(failing_while(gone, LinkError("unplugged")))
    clock, heat = flight.loop._clock, []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        gone.now = 1500 <= n < 3000
        clock.skipped = 58_500 if n == 2000 else 0  # a minute in all
        if n in {1505, 3000}:
            heat.append(flight.shared.heat.copy())
        if n == 3000:
            flight.board.clear()

    flight.run(script, 3005)
    time_constant_s = flight.rig.limits.coil_time_constant_s
    assert heat[1] == pytest.approx(heat[0])
    expected = heat[0] * np.exp(-60.0 / time_constant_s)
    assert flight.shared.heat == pytest.approx(expected, rel=0.02)
