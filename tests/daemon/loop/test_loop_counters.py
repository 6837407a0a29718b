"""Test the counters and rows of the loop after late, failed and skipped cycles."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from loop_with_scripted_clock import LIFT, ScriptedLoop

from levid.daemon.control.faults import Fault
from levid.daemon.control.states import State
from levid.daemon.ipc.shared_status_words import Word
from levid.drivers.base import Backend, Devices, StaleError


def test_homing_is_not_counted_as_a_cycle() -> None:
    """A clear may take 10 s; it must not count as a cycle of 10 s, nor the next one as late."""
    flight = ScriptedLoop(recover=lambda: time.sleep(0.2))
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped = {401: 200, 501: 3}.get(n, 0)
        if n == 300:
            flight.control_words.stop()
        if n == 400:
            flight.control_words.clear()

    flight.run(script, 600)
    assert flight.control_words.fault is Fault.NONE
    figures = flight.shared.timing.figures()
    assert figures["execution_us"]["max"] < 0.15e6
    assert sum(figures["late_by"].values()) == 1  # the cycle that was late
    assert flight.control_words[Word.LATE] == 1
    rows = flight.shared.ring.last(300).rows
    assert rows["execution_s"].max() < 0.15
    assert rows["skipped"].max() == 200


@pytest.mark.parametrize(
    ("slow", "part", "cause"),
    [
        ("amplifiers.write", "writing", "drivers"),
        ("drives.write", "writing", "drivers"),
        ("sensors.read", "drivers", "drivers"),
        ("state_machine.advance", "control", "control"),
    ],
)
def test_time_is_counted_to_its_part_of_the_cycle(slow: str, part: str, cause: str) -> None:
    flight = ScriptedLoop()
    loop, clock = flight.loop, flight.clock
    whose, name = slow.split(".")
    one = loop.state_machine if whose == "state_machine" else getattr(flight.devices, whose)
    takes_long = False

    def script(n: int) -> None:
        nonlocal takes_long
        takes_long = n == 300
        clock.skipped = 19 if n == 301 else 0
        if n == 300 and whose == "state_machine":  # it changes its method with each segment
            slowly()

    def slowly() -> None:
        usual = getattr(one, name)

        def action(*arguments: object) -> object:
            if takes_long:
                time.sleep(0.02)
            return usual(*arguments)

        setattr(one, name, action)

    if whose != "state_machine":
        slowly()
    flight.run(script, 310)
    figures = flight.shared.timing.figures()
    assert figures["late_by"] == {"wake_up": 0, "drivers": 0, "control": 0, cause: 1}
    parts = {name: figures[f"{name}_us"]["max"] for name in ("drivers", "control", "writing")}
    assert max(parts, key=lambda name: parts[name]) == part
    assert figures["execution_us"]["max"] == pytest.approx(sum_at(flight), rel=0.05)


def sum_at(flight: ScriptedLoop) -> float:
    """Return the longest execution of the rows, us."""
    return float(1e6 * flight.shared.ring.last(300).rows["execution_s"].max())


def test_counters_are_published_if_every_cycle_is_late() -> None:
    """With every other period skipped the cycle number stays odd, and is no multiple of 64."""
    flight = ScriptedLoop()
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped = 1 if n > 100 else 0

    flight.run(script, 400)
    assert flight.control_words[Word.LATE] >= 400 - 100 - 64


def test_restarted_loop_continues_the_counts() -> None:
    flight = ScriptedLoop()
    control_words = flight.control_words
    control_words[Word.LATE], control_words[Word.STALE] = 7, 11
    flight.restart()
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped = 2 if n == 50 else 0

    flight.run(script, 200)
    assert (control_words[Word.LATE], control_words[Word.STALE]) == (8, 11)


def test_row_of_a_cycle_that_was_too_late_has_zero_force() -> None:
    flight = ScriptedLoop()
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped = 1500 if n == 1500 else 0  # more than limits.stall_s
        if n == 300:
            flight.fly({"levitate": {**LIFT, "settle_s": 5.0}})

    flight.run(script, 1502)
    assert flight.control_words.fault is Fault.LATE
    rows = flight.shared.ring.last(10).rows
    late = rows["fault"] == Fault.LATE
    assert late.sum() == 3
    assert rows["coil_n"][~late].any(axis=1).all()
    assert not rows["coil_n"][late].any()
    assert (rows["state"][late] == State.FAULT).all()


@pytest.mark.parametrize("late", [1, 100])
def test_move_requested_during_a_landing_is_dropped(late: int) -> None:
    """The supervisor checks for a landing before it announces the move, and lands again after."""
    flight = ScriptedLoop()
    control_words, seen = flight.control_words, []

    def script(n: int) -> None:
        if n == 300:
            flight.fly({"levitate": LIFT})
        if n == 2000:
            assert control_words.state is State.LEVITATING
            assert not control_words[Word.PLAN]
            control_words.land()
        if n == 2000 + late:
            flight.fly({"move": {"beam_m": 0.01}})
            flight.feed()
            control_words.land()
        seen.append(control_words.state)

    flight.run(script, 4000)
    assert control_words.fault is Fault.NONE
    assert seen[-1] is State.IDLE
    assert State.LANDING in seen
    assert State.MOVING not in seen
    assert control_words[Word.PLAN_DONE] == control_words[Word.PLAN_CUT] == flight.plans


def test_devices_get_the_lateness_without_skipped_periods() -> None:
    """Readings are awaited until the end of this cycle, whatever was skipped before."""
    heard: list[tuple[int, float]] = []

    class Listening:
        def __init__(self, backend: Backend) -> None:
            self._backend = backend

        def sync(self, cycle: int, late_s: float = 0.0) -> None:
            heard.append((cycle, late_s))
            self._backend.sync(cycle, late_s)

        def __getattr__(self, name: str) -> object:
            return getattr(self._backend, name)

    flight = ScriptedLoop(
        lambda devices: replace(devices, backends=(Listening(devices.backends[0]),))
    )
    clock = flight.clock

    def script(n: int) -> None:
        clock.skipped, clock.late_s = (3, 3.4e-3) if n == 50 else (0, 2e-5)

    before = len(heard)
    flight.run(script, 60)
    told = [late_s for _, late_s in heard[before:]]
    assert told[49] == pytest.approx(0.4e-3)
    assert told[48] == told[50] == 2e-5


def test_missing_readings_at_rest_are_published() -> None:
    """A cycle with an error writes no row; the counters have to advance all the same."""
    silent = SimpleNamespace(now=False, stale=0)

    class Counting:
        def __init__(self, backend: Backend) -> None:
            self._backend = backend

        @property
        def stale(self) -> int:
            return silent.stale

        def __getattr__(self, name: str) -> object:
            return getattr(self._backend, name)

    def failing(devices: Devices) -> Devices:
        read = devices.sensors.read

        def reading(gap_m: np.ndarray) -> None:
            if silent.now:
                silent.stale += 1
                raise StaleError("no reading")
            read(gap_m)

        devices.sensors.read = reading  # type: ignore[method-assign]
        return replace(devices, backends=(Counting(devices.backends[0]),))

    flight = ScriptedLoop(failing)
    clock, control_words, seen = flight.clock, flight.control_words, []

    def script(n: int) -> None:
        clock.skipped = 2 if n == 399 else 0
        silent.now = n >= 400
        if n == 900:
            seen.extend(
                (
                    control_words.state,
                    control_words.fault,
                    control_words[Word.STALE],
                    control_words[Word.LATE],
                )
            )

    flight.run(script, 900)
    assert seen == [State.IDLE, Fault.NONE, 500, 1]
