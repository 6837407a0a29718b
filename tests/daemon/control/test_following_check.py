"""Test that coils and drives that do not follow are named, and that those that follow are not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from levid.config.rig import RigConfig, load_rig
from levid.config.shipped import shipped
from levid.daemon.control.control_cycle import Controller
from levid.daemon.control.faults import Fault
from levid.daemon.control.feed_forward import feed_forward
from levid.daemon.control.flight_segment import Segment, idle_segment
from levid.daemon.control.following_limits import beam_follow_m, coil_follow_n, coil_lag_s
from levid.daemon.control.states import State
from levid.log.signals import Stale, cycle_dtype

RIG = load_rig(shipped("rigs/loopback.yaml"))
HOVER_N = 7.0 * 9.81 / 9
WITHIN = 5
"""Cycles within which a fault must be named."""


def hovering(cycles: int, excitation_n: np.ndarray | None = None, **more: object) -> Segment:
    zero = np.zeros((1, 3))
    coil = np.zeros((1, 9)) if excitation_n is None else excitation_n
    segment = Segment(State.EXCITING, cycles, zero, coil, np.ones((1, 3)), zero, zero, engages=True)
    return replace(segment, **more)


class Rig:
    """A controller on amplifiers and drives with a first-order lag, in an undisturbed plant.

    force: what coil amplifiers drive for a command (9,). follow_s: lag of the drives.
    """

    def __init__(
        self,
        rate_hz: float = 1000.0,
        lag_s: float = 3e-4,
        noise_n: float = 1e-3,
        rig: RigConfig = RIG,
    ) -> None:
        self.period_s = 1.0 / rate_hz
        self.control = Controller(rig, self.period_s)
        self.rows = np.zeros(1, cycle_dtype(9, 9))
        self.force: Callable[[np.ndarray], np.ndarray] = lambda command: command
        self.drive_lag_s, self.jammed = 0.0, False
        self._decay, self._noise_n = math.exp(-self.period_s / lag_s), noise_n
        self._rng = np.random.default_rng(1)
        self._acting, self._current = np.zeros(9), np.zeros(9)
        self._setpoint, self._at = np.zeros((2, 3)), np.zeros(2)
        self.cycle = -1
        self.control.begin(idle_segment(1, 9, np.zeros(3), np.zeros(3)))
        self.control.follow(True)

    def run(
        self, segment: Segment, cycles: int, stale: Callable[[int], int] = lambda _: 0,
        skipped: Callable[[int], int] = lambda _: 0, gap_m: float = 0.0,
    ) -> tuple[Fault, int]:  # fmt: skip
        """Fly `cycles` of a segment; return the first fault and its cycle, counted from 1."""
        control = self.control
        control.begin(segment)
        for k in range(cycles):
            self.cycle += 1 + skipped(k)
            driven = self.force(self._acting)
            self._current = driven + self._decay * (self._current - driven)
            share = 1.0 if not self.drive_lag_s else -math.expm1(-self.period_s / self.drive_lag_s)
            if not self.jammed:
                self._at += share * (self._setpoint[:, 0] - self._at)
            missed = stale(k)
            if not missed & Stale.SETPOINTS:
                self._acting = control.coil_n.copy()  # written in the cycle before
                self._setpoint = np.stack([control.beam_ref, control.rotor_ref])
            control.gap_m[:] = gap_m
            if not missed & Stale.AMPLIFIERS:
                noise = self._noise_n * self._rng.standard_normal(9)
                control.readback_n[:] = self._current + noise
            if not missed & Stale.DRIVES:
                control.beam[0], control.rotor[0] = self._at
            fault = Fault(
                control.step(self.rows, 0, self.cycle, self.cycle * self.period_s, k, 0.0, missed)
            )
            if fault:
                return fault, k + 1
        return Fault.NONE, cycles


def idle() -> Segment:
    return idle_segment(1, 9, np.zeros(3), np.zeros(3))


FAULTY = {
    "dead": lambda c: c * (np.arange(9) != 4),
    "stuck": lambda c: np.where(np.arange(9) == 4, 15.0, c),
    "half": lambda c: np.where(np.arange(9) == 4, 0.5 * c, c),
    "offset": lambda c: np.where(np.arange(9) == 4, c - 2.0, c),
    "reversed": lambda c: np.where(np.arange(9) == 4, -c, c),
}


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0, 10_000.0])
@pytest.mark.parametrize("how", FAULTY)
def test_coil_that_deviates_in_flight_is_named_with_both_forces(how: str, rate_hz: float) -> None:
    rig = Rig(rate_hz)
    assert rig.run(hovering(1000), 1000)[0] is Fault.NONE
    rig.force = FAULTY[how]
    fault, cycles = rig.run(hovering(1000, engages=False), 1000)
    assert fault is Fault.AMPLIFIER
    assert cycles <= WITHIN
    text = rig.control.detail(fault)
    assert text.startswith(f"coil 4: commanded {HOVER_N:.2f} N, reads back ")
    assert np.all(rig.control.coil_n == 0.0)
    assert rig.rows["fault"][0] == Fault.AMPLIFIER


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0, 10_000.0])
def test_amplifier_that_keeps_its_force_at_rest_is_named(rate_hz: float) -> None:
    rig = Rig(rate_hz)
    assert rig.run(idle(), 100)[0] is Fault.NONE
    rig.force = lambda c: c + 7.63 * (np.arange(9) == 7)
    fault, cycles = rig.run(idle(), 100)
    assert (fault, cycles <= WITHIN) == (Fault.AMPLIFIER, True)
    assert rig.control.detail(fault).startswith("coil 7: commanded 0.00 N, reads back ")


def test_amplifier_that_has_kept_its_force_since_the_devices_were_opened_is_named() -> None:
    rig = Rig()
    rig.force = lambda c: c + 7.63 * (np.arange(9) == 7)
    assert rig.run(idle(), 20)[0] is Fault.AMPLIFIER


def test_coil_that_keeps_its_force_after_control_ended_is_named() -> None:
    rig = Rig()
    assert rig.run(hovering(100), 100)[0] is Fault.NONE
    rig.control.halt()
    rig.force = lambda c: np.where(np.arange(9) == 2, HOVER_N, c)
    fault, cycles = rig.run(idle(), 100)
    # The command acts from the next cycle on, is read in the one after it, and three count.
    assert (fault, cycles <= 2 + WITHIN) == (Fault.AMPLIFIER, True)


def test_dead_coil_is_the_fault_even_if_the_platform_leaves_its_range_first() -> None:
    rig = Rig(50.0)
    assert rig.run(hovering(100), 100)[0] is Fault.NONE
    rig.force = FAULTY["dead"]
    out_of_range = RIG.limits.gap_m * 1.1
    assert rig.run(hovering(1, engages=False), 1, gap_m=out_of_range)[0] is Fault.AMPLIFIER
    other = Rig(50.0)
    assert other.run(hovering(100), 100)[0] is Fault.NONE
    assert other.run(hovering(1, engages=False), 1, gap_m=out_of_range)[0] is Fault.GAP


def test_in_a_fault_coils_are_not_judged() -> None:
    # The first fault stays in the log, and the platform has dropped already.
    rig = Rig()
    rig.control.latch(Fault.STOPPED)
    rig.force = lambda c: c + 7.63 * (np.arange(9) == 7)
    assert rig.run(idle(), 100)[0] is Fault.NONE
    rig.control.latch(Fault.NONE)
    assert rig.run(idle(), WITHIN)[0] is Fault.AMPLIFIER


def test_amplifiers_that_do_not_measure_the_force_are_not_judged() -> None:
    rig = Rig()
    rig.control.follow(False)
    rig.force = lambda c: 0.0 * c
    assert rig.run(hovering(1000), 1000)[0] is Fault.NONE


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0, 10_000.0])
@pytest.mark.parametrize("lag_s", [1e-6, 3e-4, 1e-3])
def test_steps_at_the_limits_and_lags_are_no_fault(rate_hz: float, lag_s: float) -> None:
    """Bursts between the coil limits, at the largest rate of change, through any allowed lag."""
    rng = np.random.default_rng(3)
    n = 4000
    step_n = rng.choice([-1.0, 0.0, 1.0], (n, 9)).repeat(5, axis=0)[:n] * 12.0
    noise_n = 0.2 * coil_follow_n(RIG)  # the most that the self-test lets pass
    rig = Rig(rate_hz, lag_s, noise_n)
    assert rig.run(hovering(n, excitation_n=step_n), n)[0] is Fault.NONE


@pytest.mark.parametrize(
    "which", [Stale.AMPLIFIERS, Stale.SETPOINTS, Stale.AMPLIFIERS | Stale.SETPOINTS]
)
def test_missing_readings_and_setpoints_accuse_nobody(which: Stale) -> None:
    rng = np.random.default_rng(5)
    n = 4000
    push_n = rng.normal(0.0, 3.0, (n, 9))
    missing = rng.random(n) < 0.3
    missing[1000:1020] = True  # as many in a row as shipped rigs tolerate
    rig = Rig(1000.0, 3e-4)

    def stale(k: int) -> int:
        return int(which) if missing[k] else 0

    assert rig.run(hovering(n, excitation_n=push_n), n, stale=stale)[0] is Fault.NONE


def test_skipped_cycles_accuse_nobody() -> None:
    rng = np.random.default_rng(6)
    n = 2000
    skipped = rng.integers(0, 20, n) * (rng.random(n) < 0.1)
    rig = Rig()
    push_n = rng.normal(0.0, 3.0, (n, 9))
    found = rig.run(hovering(n, excitation_n=push_n), n, skipped=lambda k: int(skipped[k]))
    assert found[0] is Fault.NONE


def test_amplifier_that_misses_setpoints_for_long_and_keeps_its_force_is_named() -> None:
    rig = Rig()
    assert rig.run(hovering(100), 100)[0] is Fault.NONE
    rig.control.halt()
    rig.force = lambda _: np.full(9, HOVER_N)
    assert rig.run(idle(), 200, stale=lambda _: int(Stale.SETPOINTS))[0] is Fault.AMPLIFIER


def moving(cycles: int, period_s: float, to_m: float = 0.05, velocity_m_s: float = 0.1) -> Segment:
    t = np.arange(1, cycles + 1) * period_s
    s = np.clip(t * velocity_m_s / to_m / 1.875, 0.0, 1.0)
    beam = np.zeros((cycles, 3))
    beam[:, 0] = to_m * s**3 * (10 - 15 * s + 6 * s**2)
    return hovering(cycles, beam=beam, rotor=beam * 20.0)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0, 10_000.0])
def test_drive_that_does_not_move_is_named_before_the_move_ends(rate_hz: float) -> None:
    n = round(1.5 * rate_hz)
    rig = Rig(rate_hz)
    rig.jammed = True
    fault, cycles = rig.run(moving(n, rig.period_s), n)
    assert fault is Fault.DRIVE
    setpoint_m = rig.control.beam_ref[0]
    # Its lag explains v times 20 ms, and it must last for as long.
    assert setpoint_m <= beam_follow_m(RIG, feed_forward(RIG, 1e-3)) + 0.1 * 0.12
    assert cycles < n
    assert rig.control.detail(fault).startswith("the beam is at 0.000 mm, its setpoint is ")


def test_slow_drive_is_named() -> None:
    rig = Rig()
    rig.drive_lag_s = 0.3
    assert rig.run(moving(1500, 1e-3), 1500)[0] is Fault.DRIVE


@pytest.mark.parametrize("lag_s", [0.0, 0.005, 0.02])
def test_drive_that_lags_as_allowed_is_no_fault(lag_s: float) -> None:
    rig = Rig()
    rig.drive_lag_s = lag_s
    rng = np.random.default_rng(7)
    missing = rng.random(1500) < 0.3
    segment = moving(1500, 1e-3, velocity_m_s=0.5)
    found = rig.run(segment, 1500, stale=lambda k: int(Stale.DRIVES) * int(missing[k]))
    assert found[0] is Fault.NONE


def test_rotor_that_does_not_turn_is_named() -> None:
    segment = moving(1500, 1e-3)
    rig = Rig()
    rig.jammed = True
    fault, _ = rig.run(replace(segment, beam=np.zeros((1, 3))), 1500)
    assert fault is Fault.DRIVE
    assert rig.control.detail(fault).startswith("the rotor is at 0.0000 rad, its setpoint is ")


def test_beam_limit_follows_from_its_weight_and_the_gains() -> None:
    law = feed_forward(RIG, 1e-3)
    # m_b g dx / kp of tilt at 0.12 m is a tenth of gap_m.
    expected_m = 0.1 * RIG.limits.gap_m * RIG.control.kp[1] / (1.4 * 9.81 * 0.12)
    assert beam_follow_m(RIG, law) == pytest.approx(expected_m, rel=1e-6)
    stated = RIG.model_copy(
        update={"limits": RIG.limits.model_copy(update={"beam_follow_m": 0.003})}
    )
    assert beam_follow_m(stated, law) == 0.003


def test_coil_limits_follow_from_the_rig() -> None:
    law = feed_forward(RIG, 1e-3)
    assert coil_follow_n(RIG) == pytest.approx(0.025 * 20.0)
    assert coil_lag_s(RIG, law) == 1e-3  # twice the model's 0.3 ms is less
    assert coil_lag_s(RIG, replace(law, lag_s=2e-3)) == 4e-3
