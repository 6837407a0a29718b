"""Test stop requests and a lost supervisor, in combination with other events of a cycle."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from loop_with_scripted_clock import LIFT, ScriptedLoop

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.supervision.supervisor import Supervisor
from levid.drivers.base import Backend, Devices, FirstError, LinkError, StaleError


def failing_while(when: SimpleNamespace, error: Exception) -> Callable[[Devices], Devices]:
    """Return a wrapper of devices whose readings raise this error while `when.now` is true."""

    def failing(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            if when.now:
                raise error
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return devices

    return failing


def test_clear_does_not_cancel_a_later_stop() -> None:
    flight = ScriptedLoop()
    supervisor = SimpleNamespace(
        control_words=flight.control_words,
        _loop=SimpleNamespace(running=True, forget_stop=lambda: None),
        _pending_clears=SimpleNamespace(add=lambda *_: None),
        job_runner=SimpleNamespace(note_fault=lambda: None),
    )  # fmt: skip

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        if n == 1500:
            assert flight.control_words.state is State.LEVITATING
            flight.control_words.stop()
            Supervisor.clear(supervisor, SimpleNamespace(), flight.control_words[Word.STOPS])

    flight.run(script, 1510)
    assert flight.forces == 0.0
    assert flight.control_words.state is not State.LEVITATING
    assert not flight.control_words[Word.ZERO]  # it is cleared and does not stop the next flight


@pytest.mark.parametrize("gone", ["zero", "land"])
def test_silent_supervisor_leads_to_a_landing_or_zero_force(gone: str) -> None:
    flight = ScriptedLoop(supervisor_s=0.5, supervisor_gone=gone)
    control_words, landing, at_zero = flight.control_words, [], []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        flight.silent = n >= 1500
        if control_words.state is State.LANDING:
            landing.append(n)
        if n > 1500 and not flight.forces:
            at_zero.append(n)

    flight.run(script, 3000)
    assert control_words.fault is Fault.SUPERVISOR
    assert "no heartbeat" in control_words.detail
    if gone == "zero":
        assert not landing
        assert 1995 <= at_zero[0] <= 2015  # the last heartbeat is at most ten cycles old
    else:
        assert 1995 <= landing[0] <= 2015
        assert abs(len(landing) - 700) <= 2  # the landing of this flight
        assert at_zero[0] >= landing[-1]


def test_supervisor_stopped_for_less_than_its_time_is_no_fault() -> None:
    flight = ScriptedLoop(supervisor_s=0.5)

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 4.0}})
        flight.silent = 1500 <= n < 1950

    flight.run(script, 3000)
    assert flight.control_words.state is State.LEVITATING
    assert flight.control_words.fault is Fault.NONE


@pytest.mark.parametrize(("stall_s", "periods"), [(None, 13), (0.3, 300)])
def test_stalled_loop_commands_zero_force(stall_s: float | None, periods: int) -> None:
    """1 kHz on loopback, gap_m 0.85 mm: a free fall takes 13.2 ms, unless the rig says more."""
    for skipped in (periods, periods + 1):
        flight, written = ScriptedLoop(limits={"stall_s": stall_s}), []

        def script(
            n: int,
            flight: ScriptedLoop = flight,
            skipped: int = skipped,
            written: list[float] = written,
        ) -> None:
            if n == 300:
                flight.fly({"levitate": {**LIFT, "settle_s": 4.0}})
            flight.clock.skipped = skipped if n == 1500 else 0
            if n >= 1500:
                written.append(flight.forces)

        flight.run(script, 1510)
        late = skipped > periods
        assert flight.control_words.fault is (Fault.LATE if late else Fault.NONE)
        assert ("stalled" in flight.control_words.detail) is late
        # The first force after the stall is zero.
        assert written[0] > 10.0
        assert (max(written[1:]) == 0.0) is late


def test_slow_cycle_commands_zero_force(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    held, now = SimpleNamespace(now=False), time.perf_counter_ns
    ahead = [0]

    def holding(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            ahead[0] += 200_000_000 * held.now
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return devices

    # A clock that advances during the delay only: the machine may be busy.
    began = now()
    monkeypatch.setattr(
        "levid.daemon.loop.real_time_loop.time.perf_counter_ns", lambda: began + ahead[0]
    )
    flight, written = ScriptedLoop(holding, limits={"stall_s": 0.15}, timed=True), []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 4.0}})
        if n >= 1500:
            written.append(flight.forces)
        held.now = n == 1500

    flight.run(script, 1510)
    assert flight.control_words.fault is Fault.LATE
    assert "a cycle took 0.2 s" in flight.control_words.detail
    assert written[0] > 10.0
    assert max(written[1:]) == 0.0
    rows = flight.shared.ring.last(20).rows
    assert not rows["coil_n"][rows["fault"] == Fault.LATE].any()
    assert (rows["state"][rows["fault"] == Fault.LATE] == State.FAULT).all()


def test_client_is_told_of_a_silent_supervisor() -> None:
    flight = ScriptedLoop(supervisor_s=0.5)
    control_words = flight.control_words

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 8.0}})
        flight.silent = n >= 1500

    flight.run(script, 4000)
    assert control_words.fault is Fault.SUPERVISOR
    assert (
        control_words[Word.FAULT_PLAN]
        == control_words[Word.PLAN_DONE]
        == control_words[Word.PLAN_CUT]
        == 1
    )


@pytest.mark.parametrize("silence", ["in flight, and a stop as it lands", "as it lands"])
def test_loop_without_supervisor_lands(silence: str, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedLoop(supervisor_gone="land", supervisor_s=0.2)
    control_words, landing, seen = flight.control_words, [], []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"land": {}})
        if control_words.state is State.LANDING:
            landing.append(n)
        if silence == "as it lands":
            flight.silent = bool(landing) and landing[0] + 10 <= n < landing[0] + 300
        else:
            flight.silent = 1000 <= n < 1250
            if n == 1260:
                control_words.stop()
        if n == 5000:
            seen.append(control_words.fault)
            control_words.clear()
        if n == 6000:
            flight.fly({"levitate": LIFT})
        if n == 8000:
            seen.append(control_words.state)
            monkeypatch.setattr(os, "getppid", lambda: 1)
        if n >= 8000:
            flight.silent = True

    flight.run(script, 10_000)
    assert seen == [
        Fault.SUPERVISOR if silence == "as it lands" else Fault.STOPPED,
        State.LEVITATING,
    ]
    assert flight.forces == 0.0
    assert control_words.state in (State.FAULT, State.OFF)


@pytest.mark.parametrize("land", [{"ramp_s": 8.0}, {"ramp_s": 2.0, "release_s": 7.0}])
def test_loop_without_supervisor_completes_its_landing(
    land: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are sent a few seconds ahead; then the loop continues from the last one."""
    flight = ScriptedLoop(supervisor_gone="land", supervisor_s=0.2)
    control_words, forces, landing = flight.control_words, [], []
    ramp, release = round(1e3 * land["ramp_s"]), round(1e3 * land.get("release_s", 0.5))

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"land": land})
            control_words[Word.LAND_RAMP], control_words[Word.LAND_RELEASE] = ramp, release
        if control_words.state is State.LANDING:
            landing.append(n)
            forces.append(flight.forces)
        if landing and not flight.silent:
            flight.silent = True
            monkeypatch.setattr(os, "getppid", lambda: 1)

    flight.run(script, 14_000)
    # A landing that started again or ended early would have another length.
    assert abs(len(landing) - (ramp + release)) <= 2
    # What the coils carry changes from one cycle to the next by noise of the readings alone.
    assert np.abs(np.diff(forces)).max() < 0.1 * forces[0]
    assert control_words.fault is Fault.SUPERVISOR


def test_landing_requested_before_lift_off_stays_on_the_ground() -> None:
    flight = ScriptedLoop()
    control_words, states = flight.control_words, set()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
            flight.feed()
            control_words.land()
        states.add(control_words.state)
        if n == 2000:
            assert control_words[Word.PLAN_DONE] == flight.plans
            flight.fly({"levitate": LIFT})  # the next one flies

    flight.run(script, 1990)
    assert State.LEVITATING not in states
    flight.run(script, 2500)
    assert State.LEVITATING in states


def test_stop_in_a_cycle_with_failed_readings_is_written() -> None:
    stale = SimpleNamespace(now=False)
    flight = ScriptedLoop(failing_while(stale, StaleError("no clean reading")))

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
        if n == 1500:
            assert flight.forces > 10.0
            stale.now = True
            flight.control_words.stop()

    flight.run(script, 1502)
    assert flight.forces == 0.0


def test_lost_bus_takes_no_memory() -> None:
    """Garbage collection is off in the loop: exceptions of each cycle must not form cycles."""
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
    assert flight.control_words.fault is Fault.LINK
    # Living objects that were created since the last collection.
    assert counts[1] - counts[0] < 100


def test_suspended_machine_has_not_lost_its_supervisor() -> None:
    flight = ScriptedLoop(supervisor_s=1.0)
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped = 1500 if n == 1500 else 0
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 5.0}})
        if n == 1500:
            assert flight.control_words.state is State.LEVITATING

    flight.run(script, 1600)
    assert flight.control_words.fault is not Fault.SUPERVISOR


def test_heat_of_the_coils_outlasts_the_loop() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})

    flight.run(script, 2000)
    hot = flight.controller.heat.copy()
    assert hot.min() > 0.0
    again = type(flight.controller)(flight.rig, 1e-3, flight.shared.control)
    assert again.heat == pytest.approx(hot)
    assert not again.pose.any()


def test_coils_cool_down_while_readings_fail() -> None:
    """Otherwise a lift-off after a lost link of hours ends in the fault HEAT."""
    gone = SimpleNamespace(now=False)
    flight = ScriptedLoop(failing_while(gone, LinkError("unplugged")))
    clock, heat = flight.clock, []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 2.0}})
        gone.now = 1500 <= n < 3000
        clock.skipped = 58_500 if n == 2000 else 0  # a minute in all
        if n in {1505, 3000}:
            heat.append(flight.shared.heat.copy())
        if n == 3000:
            flight.control_words.clear()

    flight.run(script, 3005)
    time_constant_s = flight.rig.limits.coil_time_constant_s
    assert heat[1] == pytest.approx(heat[0])
    expected = heat[0] * np.exp(-60.0 / time_constant_s)
    assert flight.shared.heat == pytest.approx(expected, rel=0.02)
