"""Whatever comes together in one cycle, who is to stop stops, and who is alone does not fly."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_loop import LIFT, ScriptedLoop

from levid.daemon.board import Word
from levid.daemon.faults import Fault
from levid.daemon.parent_watch import is_stopped
from levid.daemon.states import State
from levid.daemon.supervisor import Supervisor
from levid.drivers.base import Devices, StaleError


def test_clear_does_not_take_back_a_stop_that_nobody_has_looked_at() -> None:
    flight = ScriptedLoop()
    supervisor = SimpleNamespace(
        board=flight.board, _stop_s=None, _clearings=[], _loop=SimpleNamespace(running=True)
    )

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        if n == 1500:
            assert flight.board.state is State.LEVITATING
            flight.board.stop()
            Supervisor.clear(supervisor, SimpleNamespace())

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
    assert is_stopped(b"7 (levid) T 1 7 7")
    assert is_stopped(b"7 (a) S (b) T 1 7 7")
    for state in (b"S", b"R", b"D", b"t"):
        assert not is_stopped(b"7 (T) T) " + state + b" 1 7 7")
    assert not is_stopped(b"")
    assert not is_stopped(Path("/proc/self/stat").read_bytes())


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
            board[Word.CLEAR] += 1
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


def test_stop_in_the_cycle_that_readings_fail_in_is_written() -> None:
    stale = SimpleNamespace(now=False)

    def failing(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            if stale.now:
                raise StaleError("no clean reading")
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return devices

    flight = ScriptedLoop(failing)

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
        if n == 1500:
            assert flight.forces > 10.0
            stale.now = True
            flight.board.stop()

    flight.run(script, 1502)
    assert flight.forces == 0.0


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
