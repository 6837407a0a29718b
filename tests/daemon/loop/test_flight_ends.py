"""Test the end of a flight, cycle by cycle: no setpoint or force jumps, whatever ends it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from loop_with_scripted_clock import LIFT, RIG, ScriptedLoop
from numpy.typing import NDArray

from levid.config.rig import load_rig
from levid.config.session import Step
from levid.daemon.control.control_cycle import Controller
from levid.daemon.control.faults import Fault, FlightFault
from levid.daemon.control.states import State
from levid.daemon.ipc.shared_status_words import Word
from levid.daemon.loop.clock import RealClock, VirtualClock
from levid.daemon.loop.prepare_first_cycle import locate
from levid.daemon.loop.virtual_flight import Flight
from levid.daemon.planning.plan import plan_steps
from levid.drivers.base import Context, Devices, DriveError, DriverError, LinkError, StaleError
from levid.drivers.open_backends import open_devices
from levid.log.reader import read_log

LAND = {"ramp_s": 0.5, "release_s": 0.3}


def rows_of(flight: ScriptedLoop, cycles: int) -> NDArray[np.void]:
    return flight.shared.ring.last(cycles).rows


def flown(flight: ScriptedLoop, script: Callable[[int], None], cycles: int) -> NDArray[np.void]:
    flight.run(script, cycles)
    return rows_of(flight, cycles)


@pytest.mark.parametrize("into_landing", [100, 600])
def test_who_ends_while_a_landing_is_flown_lets_it_end(into_landing: int) -> None:
    """The rows of the program have come round once: its first is one of the flight's."""
    flight = ScriptedLoop()
    landing: list[int] = []

    def script(n: int) -> None:
        if n == 300:
            move = {"beam_m": 0.05, "settle_s": 2.0}
            flight.fly({"levitate": {**LIFT, "settle_s": 4.5}}, {"move": move}, {"land": LAND})
        if flight.control_words.state is State.LANDING:
            landing.append(n)
            if len(landing) == into_landing:
                flight.control_words[Word.END] = 1

    rows = flown(flight, script, 10_000)
    assert len(landing) == 800  # the planned one
    assert flight.loop.state_machine.ended
    assert flight.control_words.state is State.OFF
    assert flight.control_words.fault is Fault.NONE
    assert flight.forces == 0.0
    landed = rows[rows["state"] == State.LANDING]
    # A step of 0.5 s down to the stops goes 0.9 mm by less than 15/8 of that a second.
    assert np.abs(np.diff(landed["z_ref_m"])).max() < 15 / 8 * 0.9e-3 / 500 + 1e-6
    assert np.ptp(landed["beam_ref_m"]) == 0.0


def test_nothing_begins_once_the_loop_is_to_end() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
        if n == 2000:
            flight.control_words[Word.END] = 1
            flight.fly({"levitate": LIFT})

    flight.run(script, 5000)
    assert flight.loop.state_machine.ended
    assert flight.control_words[Word.PLAN_DONE] == 2
    assert flight.forces == 0.0


def test_a_landing_that_goes_on_unplanned_goes_on_smoothly(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = ScriptedLoop(supervisor_gone="land", supervisor_s=0.2)

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"land": {"ramp_s": 8.0}})
            flight.control_words[Word.LAND_RAMP] = 8000
        if flight.control_words.state is State.LANDING and not flight.silent:
            flight.silent = True
            monkeypatch.setattr(os, "getppid", lambda: 1)

    rows = flown(flight, script, 14_000)
    landed = rows[rows["state"] == State.LANDING]
    assert flight.control_words.fault is Fault.SUPERVISOR
    sunk = np.diff(landed["z_ref_m"][: len(landed) - 600])
    assert np.abs(sunk).max() < 15 / 8 * 0.9e-3 / 8000 + 1e-7  # float32 of the log


def test_a_stop_while_the_beam_moves_brakes_it_within_its_limits() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"move": {"beam_m": 0.09, "rotor_rad": 2.0}})
        if flight.controller.beam_ref[1] > 0.2:
            flight.control_words.stop()

    rows = flown(flight, script, 3000)
    after = rows[rows["state"] == State.FAULT]
    limit = flight.rig.limits.beam_acceleration_m_s2
    whole = rows["beam_ref_m_s"].astype(float)
    assert abs(after["beam_ref_m_s"][0]) > 0.05
    assert np.abs(np.diff(whole)).max() < 1.01 * limit * 1e-3
    # What is told as speed is what the setpoints do, to a cycle's acceleration and float32.
    told = 0.5 * (whole[1:] + whole[:-1])
    assert np.abs(np.diff(rows["beam_ref_m"].astype(float)) / 1e-3 - told).max() < 1e-2
    assert whole[-1] == 0.0
    assert np.abs(np.diff(rows["rotor_ref_rad"].astype(float), 2)).max() < (
        1.01 * flight.rig.limits.rotor_acceleration_rad_s2 * 1e-6 + 1e-6
    )
    assert np.all(after["coil_n"] == 0.0)


def test_a_fault_in_virtual_time_brakes_the_beam_too(tmp_path: Path) -> None:
    rig = load_rig(RIG)
    plan = plan_steps([Step(levitate=LIFT), Step(move={"beam_m": 0.09})], "braked", rig, 0.0, 0.0)
    with Flight(rig, RIG.parent, 1000.0, VirtualClock()) as flight:
        read, fly = flight.devices.sensors.read, flight.loop.fly
        write, beam_m_s = flight.devices.drives.write, 0.0

        def writing(beam: NDArray[np.float64], rotor: NDArray[np.float64]) -> None:
            nonlocal beam_m_s
            beam_m_s = beam[1]
            write(beam, rotor)

        def failing(gap_m: NDArray[np.float64]) -> None:
            read(gap_m)
            if abs(beam_m_s) > 0.1 and not broken:
                broken.append(flight.loop.cycle)
                gap_m[0] = np.nan

        broken: list[int] = []
        flight.devices.sensors.read = failing  # type: ignore[method-assign]
        flight.devices.drives.write = writing  # type: ignore[method-assign]
        flight.loop.fly = fly  # type: ignore[method-assign]
        with pytest.raises(FlightFault, match="READING"):
            flight.fly(plan, tmp_path, {})
    log = read_log(next(tmp_path.glob("*-move.mcap")))
    speed = log.field("beam_ref_m_s")
    assert np.abs(np.diff(speed)).max() < 1.01 * rig.limits.beam_acceleration_m_s2 * 1e-3
    assert speed[-1] == 0.0


def test_a_beam_that_is_where_it_may_not_be_is_told_and_not_moved() -> None:
    rig = load_rig(RIG)
    controller = Controller(rig, 1e-3)
    devices = open_devices(Context(rig, 1e-3, RIG.parent))
    read = devices.drives.read

    def at(place: float) -> None:
        def reading(beam: NDArray[np.float64], rotor: NDArray[np.float64]) -> None:
            read(beam, rotor)
            beam[0] = place

        devices.drives.read = reading  # type: ignore[method-assign]

    beyond = rig.limits.beam_m + 0.003
    at(beyond)
    with pytest.raises(DriveError, match=rf"at {beyond:.4g} m, expected within"):
        locate(controller, devices, rig, 0)
    assert controller.beam_ref[0] == 0.0
    at(rig.limits.beam_m + 0.001)  # as far as it may overshoot: held there
    locate(controller, devices, rig, 0)
    assert controller.beam_ref[0] == rig.limits.beam_m + 0.001


def test_late_cycles_on_the_ground_are_not_held_against_the_flight() -> None:
    flight = ScriptedLoop()
    clock, limits = flight.clock, flight.rig.limits

    def script(n: int) -> None:
        late = n < 2 * limits.late_in_window + 600 and n % 2
        clock.skipped = 1 if late or n == 2 * limits.late_in_window + 2500 else 0
        if n == 2 * limits.late_in_window + 700:
            flight.fly({"levitate": {**LIFT, "settle_s": 3.0}})

    flight.run(script, 2 * limits.late_in_window + 2600)
    assert flight.control_words.fault is Fault.NONE
    assert flight.control_words.state is State.LEVITATING


def test_a_story_of_a_fault_is_not_cut_by_who_asks_to_land() -> None:
    flight = ScriptedLoop()

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 3.0}})
        if n == 1500:
            flight.control_words.stop()
        if n == 1510:
            flight.control_words.land()
        if n == 1520:
            flight.control_words[Word.END] = 1

    flight.run(script, 5000)
    assert flight.loop.state_machine.ended
    told = rows_of(flight, 5000)
    # Half a second of it, to the cycle in which that is noticed.
    assert np.sum(told["state"] == State.FAULT) == pytest.approx(500, abs=2)


def test_what_takes_less_than_a_cycle_takes_one() -> None:
    rig = load_rig(RIG)
    steps = [
        Step(levitate={"unload_s": 1e-6, "ramp_s": 1e-6, "settle_s": 0.0}),
        Step(record={"name": "still", "duration_s": 1e-6, "fade_s": 0.0, "settle_s": 0.0}),
        Step(land={"ramp_s": 1e-6, "release_s": 1e-6}),
    ]
    plan = plan_steps(steps, "short", rig, 0.0, 0.0)
    segments = [segment for step in plan.steps for segment in step.segments()]
    states = [segment.state for segment in segments if segment.cycles]
    assert states == [
        State.IDLE, State.LEVITATING, State.EXCITING, State.LANDING, State.LANDING, State.IDLE,
    ]  # fmt: skip
    assert any(segment.engages for segment in segments if segment.cycles)


class Monotonic:
    """A clock that goes on by what is slept, and by 1 us a look."""

    def __init__(self) -> None:
        self.ns, self.slept = 0, 0

    def monotonic_ns(self) -> int:
        self.ns += 1000
        return self.ns

    def time_ns(self) -> int:
        return self.ns

    def sleep(self, s: float) -> None:
        self.slept += round(s * 1e9)
        self.ns += round(s * 1e9)


@pytest.mark.parametrize("rate_hz", [3000.0, 15_000.0, 20_000.0])
def test_deadlines_do_not_drift_and_the_loop_sleeps(
    rate_hz: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = Monotonic()
    monkeypatch.setattr("levid.daemon.loop.clock.time", now)
    clock = RealClock(1 / rate_hz)
    clock.start()
    for _ in range(30_000):
        clock.wait()
        assert clock.skipped == 0
    # A look at the clock is 1 us; a period that is rounded to ns would be 10 us off at 3 kHz.
    assert now.ns - 1e9 * 29_999 / rate_hz == pytest.approx(0.0, abs=4000)
    assert now.slept > 0.5 * now.ns


def test_skipped_periods_are_skipped_in_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    now = Monotonic()
    monkeypatch.setattr("levid.daemon.loop.clock.time", now)
    clock = RealClock(1e-3)
    clock.start()
    clock.wait()
    now.ns += 3_500_000
    assert clock.wait() == pytest.approx(2.5e-3, abs=1e-5)
    assert clock.skipped == 2
    before = now.ns
    clock.wait()
    assert clock.skipped == 0
    assert now.ns - before == pytest.approx(0.5e6, abs=1e4)


class Told:
    """Drives that note what they are told in each cycle; nan where they are told nothing."""

    def __init__(self) -> None:
        self.beam: list[float] = []
        self._now = np.nan

    def __call__(self, devices: Devices) -> Devices:
        write, sync = devices.drives.write, devices.backends[0].sync

        def told(beam: NDArray[np.float64], rotor: NDArray[np.float64]) -> None:
            self._now = float(beam[0])
            write(beam, rotor)

        def synced(cycle: int, late_s: float = 0.0) -> None:
            self.beam.append(self._now)
            self._now = np.nan
            sync(cycle, late_s)

        devices.drives.write = told  # type: ignore[method-assign]
        devices.backends[0].sync = synced  # type: ignore[method-assign]
        return devices


@pytest.mark.parametrize("error", [StaleError("no clean reading"), LinkError("gone")])
def test_drives_are_told_to_brake_while_others_are_silent(error: DriverError) -> None:
    told, silent = Told(), []

    def failing(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: NDArray[np.float64]) -> None:
            if silent:
                raise error
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return told(devices)

    flight = ScriptedLoop(failing)

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT}, {"move": {"beam_m": 0.09}})
        if flight.controller.beam_ref[1] > 0.2:
            silent.append(n)

    flight.run(script, 2500)
    assert flight.control_words.fault in (Fault.STALE, Fault.LINK)
    beam = np.array(told.beam[2:])
    assert np.all(np.isfinite(beam))
    limit = flight.rig.limits.beam_acceleration_m_s2
    assert np.abs(np.diff(beam, 2)).max() < 1.01 * limit * 1e-6
    assert np.ptp(beam[-100:]) == 0.0


def test_drives_that_nobody_located_are_told_nothing() -> None:
    told, refused, released = Told(), [], []

    def watched(devices: Devices) -> Devices:
        devices.drives.release = lambda: released.append(True)  # type: ignore[method-assign]
        return told(devices)

    def recover() -> None:
        if refused:
            raise DriveError("the beam is at 0.15 m")

    flight = ScriptedLoop(watched, recover=recover)

    def script(n: int) -> None:
        if n == 300:
            flight.control_words.stop()
        if n == 400:
            refused.append(n)
            flight.control_words.clear()
        if n == 500:
            assert flight.control_words.fault is Fault.STOPPED
            refused.clear()
            flight.control_words.clear()

    flight.run(script, 600)
    silent = np.isnan(told.beam)
    assert len(released) == 1
    # From the clear that was refused to the one that was not, but for the cycle that it came in.
    assert np.all(silent[402:500])
    assert not np.any(silent[302:399])
    assert not np.any(silent[503:])
